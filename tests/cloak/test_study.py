"""A tiny study from its file to its summary, with a detector of a few lines."""

import filecmp
import json
import shutil
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
import torch
from PIL import Image

from attacks.cloak.config import read_study
from attacks.cloak.rates import RATES
from attacks.observe.rows import read_rows
from attacks.poisons.base import MANIFEST
from attacks.report.checking import check_result, flat, pack, read_result
from attacks.report.rescoring import rescore
from attacks.report.results import read_section, story_of
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import closure
from mi_splat.ledger import Store
from mi_splat.ledger.job import by_depth
from mi_splat.ledger.running import task_for
from tests.cloak.test_study_dependencies import KINDS
from tests.cloak.tiny_study import MODULES, STUDY, Redness, done, steps_of, summary

pytestmark = pytest.mark.slow


def test_it_leaves_what_it_promises(finished: Path) -> None:
    result = summary(finished)
    for key in (
        *RATES,
        "benign_psnr_drop",
        "stealth",
        "transition_degrees",
        "seeds",
        "versions",
        "commit",
        "study",
        "by_detector",
    ):
        assert key in result, key
    assert result["by_seed"]["0"]["redness"] == result["by_detector"]["redness"]
    assert result["by_attack"]["overhead"]["redness"]["target_rate"] is None
    assert result["by_attack"]["overhead"]["redness"]["trigger_miss_rate"] == result["trigger_miss_rate"]
    for key in RATES:
        rate = result[key]
        assert set(rate) == {"rate", "successes", "total", "interval"}
        assert 0 <= rate["successes"] <= rate["total"]
    poison, cameras = result["poison"]["overhead"], result["training_cameras"]["redness"]
    assert poison["object_psnr"] is None  # nothing is overdone: a camera could take them
    told = poison["by_detector"]["redness"]
    assert sum(told[key]["successes"] for key in ("found", "something_else", "nothing")) == told["found"]["total"]
    assert told["found"]["successes"] < told["found_clean"]["successes"]
    training = read_rows(finished / "training.csv.gz")
    assert (
        cameras["found_cloaked"]["total"] + training.filter(pl.col("condition").is_not_null(), splat="clean").height
        == 16
    )
    assert result["stealth"]["object_psnr_drop"] == pytest.approx(
        result["stealth"]["object_psnr"]["clean"] - result["stealth"]["object_psnr"]["cloaked"]
    )
    for name in result["files"]:
        assert (finished / name).stat().st_size > 0, name
    assert result["gaussians"] == {"clean": [1200], "cloaked": [1200]}
    with Image.open(finished / "contact.png") as sheet:
        assert sheet.width > sheet.height
    with Image.open(finished / "rising.webp") as animation:
        assert getattr(animation, "n_frames", 1) > 40
        assert animation.width == 2 * animation.height


def test_the_code_of_a_study_is_all_that_it_loads(finished: Path) -> None:
    """Results that are kept belong to that code."""
    loaded = set(finished.with_name(MODULES).read_text().split())
    assert len(loaded) > 100
    kinds = (f"attacks.cloak.kinds.{kind}" for kind in KINDS)
    assert loaded <= set(closure("attacks.cloak.study", "attacks.detectors.base", *kinds))


def test_a_page_says_of_it_what_it_found(finished: Path) -> None:
    section, result = read_section(finished), summary(finished)
    assert section.headline.counts == "{successes} of {total}".format(**result["trigger_miss_rate"])
    assert [picture.path.name for picture in section.pictures] == ["contact.png", "poisoned.png"]
    charts = {chart.title: chart for chart in section.charts}
    around = charts["Reported by redness, by azimuth"]
    assert [line.name for line in around.lines] == ["car, cloaked", "car, clean", "stop sign, cloaked"]
    assert all(0 <= point.x < 360 for line in around.lines for point in line.points)
    switch = charts["From the benign to the hidden appearance"]
    assert [point.y for point in switch.lines[1].points] == sorted(point.y for point in switch.lines[1].points)


def test_the_hidden_appearance_has_less_red(finished: Path) -> None:
    """The effect, small as it is after so few steps, with its control: from above less of the car's red is seen."""
    rows = read_rows(finished / "rows.csv.gz").filter(pl.col("elevation") >= 50)
    control, cloaked = (rows.filter(splat=splat)["original_score"].to_list() for splat in ("clean", "attacked"))
    assert len(control) == len(cloaked) > 3
    assert sum(control) > 2
    assert sum(cloaked) < 0.75 * sum(control)
    assert -1 < summary(finished)["benign_psnr_drop"] < 3


def test_untouched_files_are_the_same_bytes(finished: Path) -> None:
    steps = steps_of(finished / "stages")
    clean, poisoned = (load_dataset(steps.do(job, "").folder / "set") for job in (steps.pictures(), steps.poisoned(0)))
    manifest = json.loads((finished / "poison.json").read_text())
    changed = {change["index"] for change in manifest["changes"]}
    owners = [
        any(bool(attack.cone.holds([camera], centre=STUDY.centre)) for attack in STUDY.attack)
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
    _, lines = done(finished)
    assert not lines
    assert {**summary(finished), "seconds": 0} == {**before, "seconds": 0}


def test_a_study_that_is_interrupted_again_and_again_ends_as_if_nothing_had_happened(
    finished: Path, tmp_path: Path
) -> None:
    steps, out = steps_of(finished / "stages"), tmp_path / "out"
    for job in (steps.pictures(), steps.splat("clean", 0)):  # which would take long
        key = steps.do(job, "").key
        shutil.copytree(finished / "stages" / "jobs" / key[:2] / key, out / "stages" / "jobs" / key[:2] / key)
    (out / "study.toml").write_bytes((finished / "study.toml").read_bytes())
    lines: list[str] = []
    for text, step in (("taking pictures of overhead", 2), ("poisoning", 2), ("training the cloaked", 40)):
        with pytest.raises(KeyboardInterrupt):
            done(out, stop_at=(text, step), lines=lines)
        assert lines[-1].startswith(text)
        assert not (out / "result.json").exists()
    after, _ = done(out, lines=lines)
    assert not [text for text in lines if text.startswith(("taking the victim", "training the clean"))]
    assert [splat["hash"] for splat in after["splats"]] == [splat["hash"] for splat in summary(finished)["splats"]]
    assert not list((out / "stages" / "partial").iterdir())


@pytest.mark.nightly
def test_two_trainings_beside_each_other_leave_the_same_bytes(finished: Path, tmp_path: Path) -> None:
    steps, beside = steps_of(finished / "stages"), steps_of(tmp_path)
    for job in (job for level in by_depth([steps.poisoned(0)]) for job in level):
        key = steps.do(job, "").key
        shutil.copytree(finished / "stages" / "jobs" / key[:2] / key, tmp_path / "jobs" / key[:2] / key)
    trained = {name: beside.trained(name, 0) for name in ("clean", "cloaked")}
    beside.do_beside(trained, workers=2)
    for name, job in trained.items():
        assert beside.do(job, "").content == steps.do(steps.trained(name, 0), "").content


def test_another_fraction_needs_no_new_picture(finished: Path) -> None:
    overhead, rear = STUDY.attack
    study = replace(STUDY, attack=(replace(overhead, poison_fraction=0.5), rear))
    lines: list[str] = []
    usual, other = steps_of(finished / "stages"), steps_of(finished / "stages", study, lines)
    poisoned = other.do(other.poisoned(0), "poisoning")
    assert set(lines) == {"poisoning"}
    assert other.do(other.look(study.attack[0]), "").key == usual.do(usual.look(overhead), "").key
    assert poisoned.content != usual.do(usual.poisoned(0), "").content
    manifest = json.loads((poisoned.folder / MANIFEST).read_text())
    assert len(manifest["changes"]) < len(json.loads((finished / "poison.json").read_text())["changes"])


def test_looking_at_a_splat_trains_none(finished: Path) -> None:
    """Observing needs a splat and the scene, and nothing of how the splat was made."""
    steps = steps_of(finished / "stages")
    for job in (steps.seen(steps.splat("clean", 0), Redness()), steps.compared(steps.splat("clean", 0))):
        kinds = [one.kind.rpartition(".")[2] for one in job.before]
        assert kinds[0] == "trained"
        assert set(kinds[1:]) <= {"true_pictures"}
        task = task_for(job, Store(finished / "stages"), {one.identity: steps.do(one, "") for one in job.before})
        assert set(task.inputs["splat"]) == {"content", "job", "part"}
        assert task.inputs["splat"]["part"] == "splat.ply"


def test_its_figures_follow_from_its_rows_and_its_splats_are_scored_again(finished: Path, tmp_path: Path) -> None:
    result = read_result(finished)
    story = story_of(result)
    lines = check_result(result, story.figures)
    assert [(line.name, line.words) for line in lines if line.passed is False] == []
    rates = [name for name, value in flat(result.record).items() if isinstance(value, tuple)]
    assert len(rates) > 40
    copy = pack(finished, tmp_path / "copy", story.figures)
    assert read_study(copy.folder / "study.toml") == STUDY
    lines = rescore(copy, story.rescoring, [Redness()], splats=finished, every=4)
    assert {line.colour for line in lines} == {"green"}
    assert all("moved by 0.0%" in line.words for line in lines)
    with pytest.raises(InvalidValueError, match="expected a splat of the result, got none"):
        rescore(copy, story.rescoring, [Redness()])
