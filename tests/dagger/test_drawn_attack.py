"""DAGGER on distributions of views, on fakes: what holds on held-out views, what may not move, controls, warnings."""

import dataclasses
import json
import math
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import cli
from attacks.budgets import Budget
from attacks.dagger.attack import attack_views
from attacks.dagger.checkpoint import Checkpoint
from attacks.dagger.config import EotConfig
from attacks.limits import NORM_NAMES, NormName
from attacks.objectives import hide, relabel, untargeted
from attacks.observe.measures import AIMS, joint_views
from attacks.observe.rates import banded, count
from attacks.observe.views import as_saved, object_boxes
from attacks.report.checking import pack, read_result
from attacks.report.exhibits import open_exhibit
from attacks.report.rescoring import rescore
from attacks.report.results import read_section, story_of
from attacks.search import Parameters, Verdict
from attacks.transformations.config import PictureChanges, Transformations
from mi_splat.attributes import Attribute
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.camera_records import camera_of, recorded_cameras
from mi_splat.io.images import through_png
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import ATTRIBUTES
from tests.dagger.toy import QUICK, REGION, quick, toy_views
from tests.fakes import CoarseDetector, ColourDetector, blobs, toy_scene


def test_an_attack_holds_on_views_that_it_did_not_see() -> None:
    result = quick()
    assert result.success
    assert result.rate.successes == result.rate.total == 8
    assert result.rates["clean_success"].successes == result.rates["noise_success"].successes == 0
    assert result.warnings == ()
    assert {view.target.original for view in result.views} == {"car"}
    attacked = {(view.index, 0) for view in toy_views().views(0, 6)}
    assert len(attacked) == 6
    held_out = [view.camera.to_world for view in toy_views().views(1000, 8)]
    assert torch.equal(held_out[0], result.views[0].view.camera.to_world)


@pytest.mark.parametrize("norm", NORM_NAMES)
@pytest.mark.parametrize("attribute", ATTRIBUTES)
def test_only_the_attribute_moves_and_stays_in_its_ball(attribute: Attribute, norm: NormName) -> None:
    scene, mask = toy_scene()
    result = quick(untargeted(), attributes=(attribute,), norm=norm, eps=(0.4,), steps=3, sh_degree=1, held_out=2)
    assert 0 < result.used[attribute] <= 0.4
    assert result.changed_gaussians <= int(mask.sum())
    for name in ATTRIBUTES:
        before, after = getattr(scene, name), getattr(result.scene, name)
        assert torch.equal(before[~mask], after[~mask])
        assert torch.equal(before, after) == (name != attribute)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_changes_up_to_a_degree(degree: int) -> None:
    result = quick(sh_degree=degree)
    scene, mask = toy_scene()
    assert result.scene.degree == max(degree, 1)
    before = scene.with_degree(result.scene.degree).sh[mask]
    moved = (result.scene.sh[mask] != before).any(-1).any(0)
    assert moved.tolist() == [k < (degree + 1) ** 2 for k in range(before.shape[1])]


def test_the_control_moves_what_the_attack_moves_by_as_much() -> None:
    result = quick(sh_degree=0, norm="l2", eps=(12.0,))
    assert len(result.judgement.noise_images) == 1
    assert result.used_in_file["sh"] == pytest.approx(result.used["sh"], rel=1e-5)
    assert result.judgement.noise_images[0].outside == pytest.approx(result.judgement.image.outside, abs=0.02)


def test_the_control_has_draws_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds, plain = [], Budget.noise

    def noise(budget: Budget, parameters: Parameters, reference: Parameters, generator: torch.Generator) -> Parameters:
        seeds.append(generator.initial_seed())
        return plain(budget, parameters, reference, generator)

    monkeypatch.setattr(Budget, "noise", noise)
    quick(seed=7, noise_draws=2, steps=1)
    assert seeds == [8, 8]  # not those of the attack's views and starting points, which have the seed 7


def test_psnr_is_that_of_the_mean_squared_error_over_all_views() -> None:
    result, views = quick(), toy_views()
    clean, attacked = views.scene.with_degree(3), as_saved(result.scene)
    errors = [
        (through_png(blobs(clean, view.camera)) - through_png(blobs(attacked, view.camera))).double().square().mean()
        for view in views.views(1000, 8)
    ]
    assert result.judgement.image.psnr == pytest.approx(-10 * math.log10(float(torch.stack(errors).mean())), abs=1e-3)


def test_picture_changes_are_seen_by_the_detector_and_not_by_the_psnr() -> None:
    changes = PictureChanges(exposure=0.2, blur=0.5, noise=0.02, jpeg=60)
    result = quick(views=toy_views(changes))
    judged = attack_views(
        toy_views(), ColourDetector(), relabel("person"), config=EotConfig(**QUICK), judged=toy_views(changes)
    )
    plain = quick()
    assert result.rate.successes >= 6
    assert judged.judgement.image.psnr == pytest.approx(plain.judgement.image.psnr)
    assert not torch.equal(judged.views[0].clean.image, plain.views[0].clean.image)
    assert judged.judged is not None
    assert judged.judged.pictures == changes
    assert judged.transformations == Transformations(cameras=REGION)


def test_several_detectors_have_to_be_deceived_together() -> None:
    class Shy(ColourDetector):
        """Never reports a person."""

        name = "shy"

        def detect(self, images: torch.Tensor) -> list[Any]:
            return [
                dataclasses.replace(one, boxes=one.boxes[:0], scores=one.scores[:0], labels=())
                for one in super().detect(images)
            ]

    result = attack_views(toy_views(), [ColourDetector(), Shy()], relabel("person"), config=EotConfig(**QUICK))
    rows = result.looked.rows
    names = ("fake_colour", "shy")
    alone = {name: count(joint_views(rows.filter(detector=name)), AIMS)[()]["success"] for name in names}
    assert alone["fake_colour"].successes == 8
    assert alone["shy"].successes == result.rate.successes == 0
    assert result.rate.total == 8
    assert not result.success
    assert any("shy finds the clean object in 0 of 8" in warning for warning in result.warnings)


def test_the_same_seeds_find_the_same_bits() -> None:
    first, second, other = quick(), quick(), quick(seed=5)
    assert torch.equal(first.scene.sh, second.scene.sh)
    assert not torch.equal(first.scene.sh, other.scene.sh)


def test_radii_make_a_curve_of_attacks_on_the_same_views_in_one_call(tmp_path: Path) -> None:
    views, config = toy_views(), EotConfig(**QUICK)
    curve = attack_views(views, ColourDetector(), relabel("person"), config=config, eps=[0.5, 2])
    assert [result.config.eps for result in curve] == [(0.5,), (2.0,)]
    for radius, result in zip((0.5, 2.0), curve, strict=True):
        assert torch.equal(result.scene.sh, quick(eps=(radius,)).scene.sh)
        assert result.used["sh"] <= radius
    assert curve[1].best.score > curve[0].best.score
    kept = Checkpoint(path=tmp_path / "search.checkpoint")
    refused: Any = {"eps": [1.0], "checkpoint": kept}
    for wrong, named in ((refused, "checkpoint: expected none with eps"), ({"eps": []}, "eps: expected at least one")):
        with pytest.raises(InvalidValueError, match=named):
            attack_views(views, ColourDetector(), relabel("person"), **wrong)


def test_the_best_step_is_the_validation_s() -> None:
    result = quick()
    judged = [line for line in result.trace if line.score >= 0]
    assert [line.index for line in judged] == [3, 6, 8]
    assert result.best.score == max(line.score for line in judged)
    assert result.best.index > 0


def test_enough_success_can_end_the_search() -> None:
    result = quick(stop_at=1.0, steps=30)
    assert result.success
    assert result.trace[-1].index < 30


def test_scores_order_by_successes_first() -> None:
    def row(success: bool, score: float) -> list[Verdict]:
        return [Verdict(success=success, score=score, unambiguous=success)]

    def score(*rows: list[Verdict]) -> float:
        return EotConfig().verdict(rows).score

    assert score(row(True, 0.7), row(False, 0.0)) > score(row(False, 0.69), row(False, 0.69))
    assert score(row(True, 0.9), row(False, 0.0)) > score(row(True, 0.7), row(False, 0.0))
    assert not EotConfig(required_views=0.6).verdict([row(True, 0.7), row(False, 0.0)]).success
    assert EotConfig(required_views=0.5).verdict([row(True, 0.7), row(False, 0.0)]).success


def test_success_over_an_angle_counts_every_view_once() -> None:
    result = quick()
    rows, success = result.looked.rows, AIMS["success"]
    parts = banded(rows, "elevation", (0.0, 30.0), 3, success)
    assert sum(part["total"] for part in parts) == 8
    assert [part["from"] for part in parts] == [0.0, 10.0, 20.0]
    assert banded(rows, "elevation", (5.0, 5.0), 3, success) == []


def test_hiding_works_as_well() -> None:
    assert quick(hide()).success


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"judge_seed": 0}, "judge_seed"),
        ({"momentum": 1.0}, "momentum"),
        ({"schedule": "steep"}, "schedule"),
        ({"batch": 0}, "batch"),
        ({"stop_at": 0.0}, "stop_at"),
        ({"required_views": 1.5}, "required_views"),
        ({"eps": (1.0, 2.0)}, "eps"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any], named: str) -> None:
    with pytest.raises(InvalidValueError, match=f"^{named}: expected"):
        EotConfig(**settings)


def test_detectors_that_make_no_sense_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="target: expected one of car"):
        quick(relabel("zebra"))
    with pytest.raises(InvalidValueError, match="one detector, or several with different names"):
        attack_views(toy_views(), [ColourDetector()] * 2, hide())
    with pytest.raises(InvalidValueError, match="one detector"):
        attack_views(toy_views(), [], hide())


# The record of an attack on a distribution of views: the attack is repeated from it, and its splat is scored again


WORDS = (
    "--box -0.5 -0.5 -0.5 0.5 0.5 0.5 --azimuth 270 --elevation 0 --distance 3 --size 32 --fov 45 --near 0.3 "
    "--background 0.1 0.1 0.12 --azimuths 250 290 --elevations 0 20 --exposure 0.2 --eps 2 --steps 6 --step-factor 4 "
    "--pool 6 --validation 2 --held-out 4 --image-psnr None"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """What the command leaves behind."""
    base = tmp_path_factory.mktemp("eot")
    save_splat(toy_scene()[0], base / "a.ply")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("attacks.cli.names.load_detectors", lambda *_: [ColourDetector()])
        assert cli.main(["dagger", "--region", str(base / "a.ply"), *WORDS.split(), "--out", str(base / "out")]) == 0
    return base / "out"


def stored(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return document


def test_the_command_is_stored_and_repeats_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, line = stored(folder), read_section(folder).command
    program, *words = shlex.split(line)
    assert [program, *words] == [
        "mi-splat",
        "dagger",
        "--region",
        str(folder.parent / "a.ply"),
        *WORDS.split(),
        "--out",
        str(folder),
    ]
    monkeypatch.setattr("attacks.cli.names.load_detectors", lambda *_: [ColourDetector()])
    assert cli.main([*words[:-1], f"{folder}-again"]) == 0
    after = stored(Path(f"{folder}-again"))
    assert {key: after[key] for key in after if key not in ("seconds", "command")} == {
        key: before[key] for key in before if key not in ("seconds", "command")
    }


def test_it_holds_all_that_its_pictures_depend_on(folder: Path) -> None:
    values = stored(folder)
    assert (values["near"], values["background"]) == (0.3, [0.1, 0.1, 0.12])
    settings = RenderSettings(near=values["near"], background=tuple(values["background"]))
    cameras = [camera_of(view["camera"]) for view in values["views"]]
    boxes = object_boxes(toy_scene()[0], toy_scene()[1], cameras, render=Renderer(settings))
    assert [None if box is None else box.tolist() for box in boxes] == [view["box"] for view in values["views"]]
    assert len(values["views"][0]["noise_successes"]) == values["config"]["noise_draws"]
    reference = recorded_cameras(folder / "result.json")
    assert reference is not None
    assert list(reference) == ["orbit"]
    assert recorded_cameras(folder / "result.json", reference=False) is None


def test_its_copy_is_scored_again(folder: Path, tmp_path: Path) -> None:
    story = story_of(read_result(folder))
    copy = pack(folder, tmp_path / "copy", story.figures, whole=True)
    lines = rescore(copy, story.rescoring, [ColourDetector()])
    assert [line.colour for line in lines] == ["green", "green"]
    assert all("moved by 0.0%" in line.words for line in lines)
    assert {line.colour for line in rescore(copy, story.rescoring, [CoarseDetector()], every=2)} == {"grey"}

    class Blind(ColourDetector):
        min_confidence = 2.0

    looked: list[tuple[int, int]] = []
    lines = rescore(copy, story.rescoring, [Blind()], every=2, on_view=lambda done, total: looked.append((done, total)))
    assert lines[0].colour == "red"
    assert looked == [(1, 2), (2, 2)]


def test_the_splat_may_lie_elsewhere_and_is_known_by_its_hash(folder: Path, tmp_path: Path) -> None:
    story = story_of(read_result(folder))
    copy = pack(folder, tmp_path / "copy", story.figures)
    with pytest.raises(InvalidValueError, match="expected a splat of the result, got none") as error:
        rescore(copy, story.rescoring, [ColourDetector()])
    assert error.value.hint == "--splats"
    assert all(line.passed for line in rescore(copy, story.rescoring, [ColourDetector()], splats=folder))
    save_splat(toy_scene()[0], tmp_path / "attacked.ply")
    with pytest.raises(InvalidValueError, match=r"expected the SHA-256 that the manifest lists of attacked\.ply"):
        rescore(copy, story.rescoring, [ColourDetector()], splats=tmp_path)


def test_its_held_out_views_are_shown(folder: Path) -> None:
    exhibit = open_exhibit(folder, clean=folder.parent / "a.ply")
    assert [name for name in exhibit.cameras if "view" in name] == [f"held-out view {i}" for i in range(4)]
    assert set(exhibit.lines) == {"Held-out cameras"}
    assert (exhibit.settings.near, exhibit.settings.background) == (0.3, (0.1, 0.1, 0.12))
    assert len(load_splat(folder / "attacked.ply")) == len(exhibit.splat("attacked").scene)
