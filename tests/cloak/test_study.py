"""A tiny study from its file to its summary, with a detector of a few lines."""

from __future__ import annotations

import filecmp
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Tensor

from attacks.cloak import setup
from attacks.cloak.observations import observe
from attacks.cloak.rates import ROWS
from attacks.cloak.study.kept_pictures import CachedAppearance
from attacks.cloak.study.pipeline import StudyPipeline
from attacks.report.results import read_section
from mi_splat.cameras import View
from mi_splat.datasets import load_dataset
from tests.cloak.tiny_study import STUDY, Redness, done, summary

pytestmark = pytest.mark.slow


def test_it_leaves_what_it_promises(finished: Path) -> None:
    found = summary(finished)
    for key in (
        *ROWS,
        "benign_psnr_drop",
        "stealth",
        "transition_degrees",
        "seeds",
        "versions",
        "commit",
        "study",
        "by_detector",
    ):
        assert key in found, key
    assert found["by_seed"]["0"]["redness"] == found["by_detector"]["redness"]
    assert found["by_attack"]["overhead"]["redness"]["target_rate"] is None
    assert found["by_attack"]["overhead"]["redness"]["trigger_miss_rate"] == found["trigger_miss_rate"]
    for key in ROWS:
        rate = found[key]
        assert set(rate) == {"rate", "successes", "total", "interval"}
        assert 0 <= rate["successes"] <= rate["total"]
    for name in found["files"]:
        assert (finished / name).stat().st_size > 0, name
    assert found["gaussians"] == {"clean": [1200], "cloaked": [1200]}
    with Image.open(finished / "contact.png") as sheet:
        assert sheet.width > sheet.height


def test_a_page_says_of_it_what_it_found(finished: Path) -> None:
    section, found = read_section(finished), summary(finished)
    assert section.headline.counts == "{successes} of {total}".format(**found["trigger_miss_rate"])
    assert section.pictures[0].path.name == "contact.png"


def test_the_hidden_appearance_has_less_red(finished: Path) -> None:
    """The effect, small as it is after so few steps, with its control: from above less of the car's red is seen."""
    pipeline = StudyPipeline(study=STUDY, folder=finished / "stages")
    clean = pipeline.capture()
    control, cloaked = (
        [one.scores["car"] for one in item.observations if one.elevation >= 50]
        for item in observe(pipeline, pipeline.train(clean, pipeline.poison(clean)), [Redness()])
    )
    assert len(control) == len(cloaked) > 3
    assert sum(control) > 2
    assert sum(cloaked) < 0.75 * sum(control)
    assert -1 < summary(finished)["benign_psnr_drop"] < 3


def test_untouched_files_are_the_same_bytes(finished: Path) -> None:
    pipeline = StudyPipeline(study=STUDY, folder=finished / "stages")
    clean_set = pipeline.capture()
    clean, poisoned = (load_dataset(pictures.folder / "set") for pictures in (clean_set, pipeline.poison(clean_set)[0]))
    manifest = json.loads((finished / "poison.json").read_text())
    changed = {change["index"] for change in manifest["changes"]}
    owners = [
        any(bool(attack.cone.holds([camera], centre=setup.centre_of(STUDY))) for attack in STUDY.attack)
        for camera in clean.cameras
    ]
    assert changed == {index for index, owned in enumerate(owners) if owned}
    for index, (one, other) in enumerate(zip(clean.paths, poisoned.paths, strict=True)):
        assert filecmp.cmp(one, other, shallow=False) == (index not in changed)
    assert torch.equal(
        torch.stack([c.to_world for c in clean.cameras]), torch.stack([c.to_world for c in poisoned.cameras])
    )


def test_nothing_is_done_twice(finished: Path) -> None:
    before = summary(finished)
    _, said = done(finished)
    assert not said
    assert {**summary(finished), "seconds": 0} == {**before, "seconds": 0}


@pytest.mark.parametrize("stop_at", [("poisoning", 2), ("training the cloaked", 40)])
def test_an_interrupted_study_ends_as_if_nothing_had_happened(
    finished: Path, tmp_path: Path, stop_at: tuple[str, int]
) -> None:
    pipeline = StudyPipeline(study=STUDY, folder=finished / "stages")
    clean = pipeline.capture()
    splat, _ = pipeline.train(clean, pipeline.poison(clean))
    for stage in (clean.folder, splat.file.parent):  # which would take long
        shutil.copytree(stage, tmp_path / "out" / "stages" / stage.name)
    (tmp_path / "out" / "study.json").write_bytes((finished / "study.json").read_bytes())
    with pytest.raises(KeyboardInterrupt):
        done(tmp_path / "out", stop_at=stop_at)
    assert not (tmp_path / "out" / "summary.json").exists()
    after, _ = done(tmp_path / "out")
    assert [splat["hash"] for splat in after["splats"]] == [splat["hash"] for splat in summary(finished)["splats"]]


def test_another_fraction_needs_no_new_capture(finished: Path) -> None:
    overhead, rear = STUDY.attack
    study = replace(STUDY, attack=(replace(overhead, poison_fraction=0.5), rear))
    usual, other = (StudyPipeline(study=one, folder=finished / "stages") for one in (STUDY, study))
    clean = usual.capture()
    assert other.capture() == clean
    (poisoned,) = other.poison(clean).values()
    assert poisoned.content != usual.poison(clean)[0].content
    manifest = json.loads((poisoned.folder / "manifest.json").read_text())
    assert len(manifest["changes"]) < len(json.loads((finished / "poison.json").read_text())["changes"])


def test_looking_at_a_splat_trains_none(finished: Path, tmp_path: Path) -> None:
    """Observing needs a splat and the scene, and nothing of how the splat was made."""
    usual = StudyPipeline(study=STUDY, folder=finished / "stages")
    clean = usual.capture()
    splat, _ = usual.train(clean, usual.poison(clean))
    (seen,) = observe(StudyPipeline(study=STUDY, folder=tmp_path), [splat], [Redness()])
    assert {path.name.split("-")[0] for path in tmp_path.iterdir()} == {"true_pictures", "observations"}
    assert len(seen.observations) > 10


def test_cached_pictures_are_made_once(tmp_path: Path) -> None:
    made: list[int] = []

    def look(view: View, mask: Tensor) -> Tensor:
        made.append(1)
        return view.image * 0.5

    cached = CachedAppearance(look, tmp_path)
    camera = setup.training_cameras(STUDY, setup.target_of(STUDY.scene))[0]
    view = View(camera, torch.rand(40, 40, 3))
    first, second = (cached(view, torch.ones(40, 40, dtype=torch.bool)) for _ in range(2))
    assert torch.equal(first, second)
    assert len(made) == 1
    assert float((first - view.image * 0.5).abs().max()) <= 0.5 / 255 + 1e-6
