"""DAGGER on distributions of views, on fakes: what holds on held-out views, what may
not move, controls, warnings.
"""

import dataclasses
import json
import math
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import cli
from attacks.dagger.attack import attack, attack_views
from attacks.dagger.config import DaggerConfig
from attacks.dagger.views import ViewDistribution
from attacks.objectives.relabel import relabel
from attacks.observe.rows import ATTACKED, CLEAN, NOISE
from attacks.observe.views import as_saved
from attacks.report.results import read_section
from attacks.report.viewer_content import open_content
from attacks.search.budget import Budget
from attacks.search.parameters import Parameters
from attacks.transformations.config import ImageTransformations, Transformations
from mi_splat.io import load_splat, save_splat
from mi_splat.io.images import through_png
from tests.dagger.toy import QUICK, REGION, quick, toy_views
from tests.fakes import ColourDetector, blobs, camera, toy_scene


def test_an_attack_holds_on_views_that_it_did_not_see() -> None:
    result = quick()
    config = DaggerConfig.for_region(**QUICK)
    around = ViewDistribution(
        reference=camera(), transformations=toy_views().transformations
    )
    public = attack(
        *toy_scene(),
        around,
        ColourDetector(),
        relabel("person"),
        render=blobs,
        config=config,
    )
    assert torch.equal(public.scene.sh, result.scene.sh)
    assert result.success
    assert result.rate.successes == result.rate.total == 8
    assert result.figures.rate("success", splat=CLEAN).successes == 0
    assert result.figures.rate("success", splat=NOISE).total == 8
    assert result.warnings == ()
    assert {view.target.original for view in result.views} == {"car"}
    attacked = {(view.index, 0) for view in toy_views().views(0, 6)}
    assert len(attacked) == 6
    held_out = [view.camera.to_world for view in toy_views().views(1000, 8)]
    assert torch.equal(held_out[0], result.views[0].view.camera.to_world)


@pytest.mark.parametrize("degree", [0, 2])
def test_sh_changes_up_to_a_degree(degree: int) -> None:
    result = quick(sh_degree=degree)
    scene, mask = toy_scene()
    assert result.scene.degree == max(degree, 1)
    before = scene.with_degree(result.scene.degree).sh[mask]
    moved = (result.scene.sh[mask] != before).any(-1).any(0)
    assert moved.tolist() == [k < (degree + 1) ** 2 for k in range(before.shape[1])]


def test_the_control_has_draws_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = []
    plain = Budget.noise

    def noise(
        budget: Budget,
        parameters: Parameters,
        reference: Parameters,
        generator: torch.Generator,
    ) -> Parameters:
        seeds.append(generator.initial_seed())
        return plain(budget, parameters, reference, generator)

    monkeypatch.setattr(Budget, "noise", noise)
    quick(seed=7, noise_draws=2, steps=1)
    # not those of the attack's views and starting points, which have the seed 7
    assert seeds == [8, 8]


def test_psnr_is_that_of_the_mean_squared_error_over_all_views() -> None:
    result = quick()
    views = toy_views()
    clean = views.scene.with_degree(3)
    attacked = as_saved(result.scene)
    errors = [
        (
            through_png(blobs(clean, view.camera))
            - through_png(blobs(attacked, view.camera))
        )
        .double()
        .square()
        .mean()
        for view in views.views(1000, 8)
    ]
    assert result.image.psnr == pytest.approx(
        -10 * math.log10(float(torch.stack(errors).mean())), abs=1e-3
    )


def test_picture_changes_are_seen_by_the_detector_and_not_by_the_psnr() -> None:
    changes = ImageTransformations(exposure=0.2, blur=0.5, noise=0.02, jpeg=60)
    result = quick(views=toy_views(changes))
    judged = attack_views(
        toy_views(),
        ColourDetector(),
        relabel("person"),
        config=DaggerConfig.for_region(**QUICK),
        evaluation=toy_views(changes),
    )
    plain = quick()
    assert result.rate.successes >= 6
    assert judged.image.psnr == pytest.approx(plain.image.psnr)
    assert not torch.equal(judged.views[0].clean.image, plain.views[0].clean.image)
    assert judged.evaluation is not None
    assert judged.evaluation.images == changes
    assert judged.transformations == Transformations(cameras=REGION)


def test_several_detectors_have_to_be_deceived_together() -> None:
    class Shy(ColourDetector):
        """Never reports a person."""

        name = "shy"

        def detect(self, images: torch.Tensor) -> list[Any]:
            return [
                dataclasses.replace(
                    one, boxes=one.boxes[:0], scores=one.scores[:0], labels=()
                )
                for one in super().detect(images)
            ]

    result = attack_views(
        toy_views(),
        [ColourDetector(), Shy()],
        relabel("person"),
        config=DaggerConfig.for_region(**QUICK),
    )
    alone = {
        name: result.figures.rate("success", splat=ATTACKED, detector=name)
        for name in ("fake_colour", "shy")
    }
    assert alone["fake_colour"].successes == 8
    assert alone["shy"].successes == result.rate.successes == 0
    assert result.rate.total == 8
    assert not result.success
    assert any(
        "shy finds the clean object in 0 of 8" in warning for warning in result.warnings
    )


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


# The record of an attack on a distribution of views: the attack is repeated from it,
# and its splat is scored again


WORDS = (
    "--box -0.5 -0.5 -0.5 0.5 0.5 0.5 --azimuth 270 --elevation 0 --distance 3 --size"
    " 32 --fov 45 --near 0.3 --background 0.1,0.1,0.12 --azimuths 250 290 --elevations"
    " 0 20 --exposure 0.2 --eps 2 --steps 6 --step-factor 4 --pool 6 --validation 2"
    " --held-out 4 --image-psnr None"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """What the command leaves behind."""
    base = tmp_path_factory.mktemp("eot")
    save_splat(toy_scene()[0], base / "a.ply")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "attacks.cli.options.load_detectors", lambda *_: [ColourDetector()]
        )
        assert (
            cli.main(
                [
                    "dagger",
                    "--region",
                    str(base / "a.ply"),
                    *WORDS.split(),
                    "--out",
                    str(base / "out"),
                ]
            )
            == 0
        )
    return base / "out"


def stored(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return document


def test_the_command_is_stored_and_repeats_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = stored(folder)
    line = read_section(folder).command
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
    monkeypatch.setattr(
        "attacks.cli.options.load_detectors", lambda *_: [ColourDetector()]
    )
    assert cli.main([*words[:-1], f"{folder}-again"]) == 0
    after = stored(Path(f"{folder}-again"))
    volatile = ("seconds", "cpu_seconds", "command")
    assert {key: after[key] for key in after if key not in volatile} == {
        key: before[key] for key in before if key not in volatile
    }


def test_its_held_out_views_are_shown(folder: Path) -> None:
    content = open_content(folder, clean=folder.parent / "a.ply")
    assert [name for name in content.cameras if "view" in name] == [
        f"held-out view {i}" for i in range(4)
    ]
    assert (content.settings.near, content.settings.background) == (
        0.3,
        (0.1, 0.1, 0.12),
    )
    assert len(load_splat(folder / "attacked.ply")) == len(
        content.splat("attacked").scene
    )


def test_views_that_are_attacked_decide_nothing() -> None:
    """Attacked, validation and held-out views are of three seeds: none is among those
    of another group.
    """
    views = toy_views()
    config = DaggerConfig.for_region(**QUICK)
    attacked = [
        view
        for step in range(config.steps + 1)
        for view in views.attacked(step, config)
    ]
    groups = (attacked, views.validation(config), views.held_out(config))
    places = [
        {tuple(view.camera.position.tolist()) for view in group} for group in groups
    ]
    assert all(places)
    assert not places[0] & places[1]
    assert not places[0] & places[2]
    assert not places[1] & places[2]
