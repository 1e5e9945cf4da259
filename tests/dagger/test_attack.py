"""DAGGER on fakes: a table of attacks, what may not move, budgets, controls and warnings."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.budgets import NormName
from attacks.dagger.attack import Attribute, DaggerConfig, Result, attack
from attacks.dagger.problem import reached
from attacks.detectors.base import Detections
from attacks.evaluation.visibility import clamped_fraction, image_change, visible_box, visible_weight
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import Objective, hide, relabel, untargeted
from attacks.pgd import Step
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.images import quantise, through_png
from mi_splat.scene import ATTRIBUTES, GaussianScene, merge
from tests.fakes import ColourDetector, blobs, camera, toy_scene

DETECTOR = ColourDetector()

TABLE: list[tuple[tuple[Attribute, ...], tuple[float, ...], NormName, Objective]] = [
    (("sh",), (12.0,), "l2", relabel("person")),
    (("sh",), (2.0,), "linf", relabel("person")),
    (("sh",), (5.0,), "l2_per_gaussian", relabel("person")),
    (("sh",), (12.0,), "l2", relabel("stop sign")),
    (("sh",), (12.0,), "l2", hide()),
    (("sh",), (12.0,), "l2", untargeted()),
    (("means",), (3.0,), "l2", hide()),
    (("scales",), (1.5,), "linf", hide()),
    (("opacities",), (6.0,), "linf", untargeted()),
    (("rotations",), (1.0,), "l2_per_gaussian", hide()),
    (("sh", "means", "scales", "rotations", "opacities"), (5.0, 1.0, 1.0, 0.5, 1.0), "l2", untargeted()),
]


def run(objective: Objective | None = None, *, cameras: list[Camera] | None = None, **settings: Any) -> Result:
    scene, mask = toy_scene()
    config = DaggerConfig(**{"eps": (12.0,), **settings})
    views = [camera()] if cameras is None else cameras
    return attack(scene, mask, views, DETECTOR, objective or relabel("person"), render=blobs, config=config)


@pytest.mark.parametrize(("attributes", "eps", "norm", "objective"), TABLE)
def test_attack_table(
    attributes: tuple[Attribute, ...], eps: tuple[float, ...], norm: NormName, objective: Objective
) -> None:
    scene, mask = toy_scene()
    scene = scene.with_degree(3) if "sh" in attributes else scene
    found = run(objective, attributes=attributes, eps=eps, norm=norm)
    assert min(line.loss for line in found.trace) < found.trace[0].loss
    if attributes != ("rotations",):  # turning round blobs changes next to nothing
        assert found.success, found.trace
        assert found.warnings == ()
    for name, radius in zip(attributes, eps, strict=True):
        assert 0 < found.used[name] <= radius
    for attribute in ATTRIBUTES:
        before, after = getattr(scene, attribute), getattr(found.scene, attribute)
        assert torch.equal(before[~mask], after[~mask])
        assert torch.equal(before, after) == (attribute not in attributes)
    assert 0 < found.changed <= found.size == int(mask.sum())
    assert found.noise.successes == 0


def test_the_clean_object_is_found_first() -> None:
    view = run().views[0]
    assert view.before.target.original == "car"
    assert view.confidence("car", attacked=False) > 0.9
    assert view.confidence("person", attacked=False) == 0.0
    assert view.confidence("car", attacked=True) < view.confidence("person", attacked=True)


def test_the_attacked_file_has_the_coefficients_of_3dgs_unless_told_otherwise() -> None:
    scene, mask = toy_scene()
    found, plain = run(), run(sh_degree=None)
    assert found.scene.degree == 3
    assert plain.scene.degree == 1
    assert torch.equal(found.scene.sh[~mask], scene.with_degree(3).sh[~mask])
    assert found.changed <= int(mask.sum())
    assert found.image.l2 > plain.image.l2  # a longer basis vector, so more colour for the same budget
    assert found.origin["scene_hash"] == plain.origin["scene_hash"]
    assert run(hide(), attributes=("opacities",), eps=(1.0,)).scene.degree == 1


def test_a_zero_budget_changes_no_bit() -> None:
    scene, _ = toy_scene()
    everything: tuple[Attribute, ...] = ("means", "scales", "rotations", "opacities", "sh")
    found = run(attributes=everything, eps=(0.0,) * 5, sh_degree=None)
    for before, after in zip(scene.tensors(), found.scene.tensors(), strict=True):
        assert torch.equal(before, after)
    assert found.changed == 0
    assert not found.success
    assert found.image.psnr is None
    assert "the loss did not fall" in found.warnings


def test_the_result_is_judged_on_the_saved_file(tmp_path: Path) -> None:
    found = run()
    save_splat(found.scene, tmp_path / "attacked.ply")
    picture = through_png(blobs(load_splat(tmp_path / "attacked.ply"), camera()))
    assert torch.equal(picture, found.views[0].after)
    seen = DETECTOR.detect(picture[None])[0]
    assert seen.labels == found.views[0].attacked.labels
    assert found.target_confidence == pytest.approx(float(seen.scores[seen.labels.index("person")]))


def test_it_is_deterministic_and_the_seed_moves_only_what_is_random() -> None:
    runs = [run(restarts=2, early_stop=False, seed=seed) for seed in (3, 3, 4)]
    assert runs[0].trace == runs[1].trace
    assert torch.equal(runs[0].scene.sh, runs[1].scene.sh)
    first = [line for line in runs[0].trace if line.restart == 0]
    assert first == [line for line in runs[2].trace if line.restart == 0]
    assert runs[0].trace != runs[2].trace


def test_several_views_are_attacked_together() -> None:
    views = [camera(), camera(offset=0.8), camera(offset=-0.8)]
    found = run(cameras=views)
    assert found.success
    assert len(found.views) == 3
    assert all(view.verdict.success for view in found.views)
    assert found.target_confidence == min(view.confidence("person", attacked=True) for view in found.views)
    assert not torch.equal(found.views[0].before.target.box, found.views[1].before.target.box)


def test_a_fraction_of_the_views_can_be_enough() -> None:
    assert [reached([0.1, 0.9, 0.5, 0.7], fraction) for fraction in (1.0, 0.75, 0.5, 0.25)] == [0.1, 0.5, 0.7, 0.9]
    views = [camera(), camera(offset=1.5)]
    scores = [view.verdict.score for view in run(cameras=views, eps=(8.0,)).views]
    half = run(cameras=views, eps=(8.0,), required_views=0.5)
    assert half.score >= max(scores) - 1e-6 or half.success


def test_the_trace_is_heard_and_early_stop_saves_steps() -> None:
    heard: list[Step] = []
    scene, mask = toy_scene()
    found = attack(
        scene,
        mask,
        [camera()],
        DETECTOR,
        relabel("person"),
        render=blobs,
        config=DaggerConfig(eps=(20.0,)),
        on_step=heard.append,
    )
    assert tuple(heard) == found.trace
    assert found.best == found.trace[-1]
    assert found.best.index < 11
    full = run(eps=(20.0,), early_stop=False)
    assert len(full.trace) == 12
    assert full.score >= found.score


def test_the_object_may_be_named_by_mask_rows_or_slice() -> None:
    scene, mask = toy_scene()
    names = (mask, torch.nonzero(mask)[:, 0].flip(0), slice(10, 40))
    parts = [GaussianSubset.of(scene, name) for name in names]
    for part in parts:
        assert part.rows.tolist() == list(range(10, 40))
    with pytest.raises(InvalidValueError, match=r"mask: expected shape \(40,\)"):
        GaussianSubset.of(scene, mask[:-1])
    with pytest.raises(InvalidValueError, match="mask: expected at least one Gaussian"):
        GaussianSubset.of(scene, torch.zeros(40, dtype=torch.bool))
    with pytest.raises(InvalidValueError, match="mask: expected bool values or indices"):
        GaussianSubset.of(scene, torch.tensor([40]))


def test_opacities_of_one_and_zero_survive_an_attack_on_their_neighbours() -> None:
    scene, mask = toy_scene()
    opacities = scene.opacities.clone()
    opacities[10], opacities[11] = 1.0, 0.0
    scene = scene.replace(opacities=opacities)
    config = DaggerConfig(attributes=("opacities",), eps=(4.0,), norm="linf")
    found = attack(scene, mask, [camera()], DETECTOR, hide(), render=blobs, config=config)
    assert torch.isfinite(found.scene.opacities).all()
    assert found.used["opacities"] <= 4.0


def test_doubts_about_a_picture_without_a_detection() -> None:
    scene, mask = toy_scene()
    dark = scene.sh.clone()
    dark[mask, 0] = -1.4
    found = attack(scene.replace(sh=dark), mask, [camera()], DETECTOR, hide(), render=blobs)
    assert found.warnings == (
        "the clean picture of view 0 has no detection of 0.5 or more on the object",
        "the aim is reached without any attack",
        "random noise of the same size does as well",
    )


def test_noise_depends_on_the_seed_and_is_judged_like_the_attack() -> None:
    controls = [run(hide(), eps=(30.0,), norm="linf", early_stop=False, seed=seed).noise for seed in (3, 3, 4)]
    assert controls[0] == controls[1] != controls[2]
    assert len(controls[0].scores) == 5


def test_doubts_about_clamped_colours_and_zero_gradients() -> None:
    scene, mask = toy_scene()
    black = torch.where(mask[:, None, None], torch.full_like(scene.sh, 0.0), scene.sh)
    black[mask, 0] = -3.0
    scene = scene.replace(sh=black)
    found = attack(scene, mask, [camera()], DETECTOR, relabel("person"), render=blobs)
    assert found.clamped == 1.0
    assert "100% of the object's colour channels are clamped at 0, where SH has no gradient" in found.warnings
    assert "up to 100% of the gradient's elements are exactly zero" in found.warnings
    assert "the loss did not fall" in found.warnings
    assert not found.success


def test_a_success_that_eight_bits_lose_is_doubted() -> None:
    class Fickle(ColourDetector):
        """Sees persons only before `attack` comes to judge the file: a stand-in for rounding."""

        calls = 0

        def detect(self, images: Tensor) -> list[Detections]:
            self.calls += 1
            car = super().detect(images)[0]
            return [dataclasses.replace(car, labels=("person",)) if self.calls == 2 else car]

    scene, mask = toy_scene()
    found = attack(scene, mask, [camera()], Fickle(), relabel("person"), render=blobs, config=DaggerConfig(eps=(0.1,)))
    assert "success in the search did not survive the saved file and 8-bit pictures" in found.warnings
    assert not found.success


def test_provenance_is_complete() -> None:
    origin = run().origin
    assert origin["detector"] == "fake_colour"
    assert len(origin["scene_hash"]) == 64
    assert {"python", "torch", "numpy"} <= set(origin["versions"])
    assert set(origin) == {"detector", "scene_hash", "versions", "variant", "commit"}


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"attributes": ("sh", "means")}, "eps: expected one number for each of sh, means"),
        ({"attributes": ("sh", "sh"), "eps": (1.0, 1.0)}, "eps: expected one number for each"),
        ({"eps": (-1.0,)}, "radius of sh: expected a finite number >= 0"),
        ({"attributes": ("colour",)}, "attribute: expected one of means"),
        ({"norm": "l7"}, "norm: expected one of linf"),
        ({"steps": 0}, "steps: expected a number >= 1"),
        ({"restarts": 0}, "restarts: expected a number >= 1"),
        ({"noise_draws": -1}, "noise_draws: expected a number >= 0"),
        ({"sh_degree": 4}, "sh_degree: expected 0, 1, 2 or 3, got 4"),
        ({"required_views": 0.0}, "required_views: expected a fraction in"),
        ({"step_factor": float("nan")}, "step_factor: expected a positive number"),
    ],
)
def test_a_wrong_configuration_says_what_is_wrong(settings: dict[str, Any], complaint: str) -> None:
    with pytest.raises(InvalidValueError, match=complaint):
        DaggerConfig(**settings)


def test_wrong_arguments_say_what_is_wrong() -> None:
    scene, mask = toy_scene()
    with pytest.raises(InvalidValueError, match="target: expected one of car, person, stop sign, got tram"):
        attack(scene, mask, [camera()], DETECTOR, relabel("tram"), render=blobs)
    with pytest.raises(InvalidValueError, match="cameras: expected at least one camera"):
        attack(scene, mask, [], DETECTOR, hide(), render=blobs)
    away = dataclasses.replace(camera(), to_world=camera(offset=200.0).to_world)
    aside = dataclasses.replace(away, principal=(-500.0, 16.0))
    with pytest.raises(InvalidValueError, match="camera: expected a view in which the object is visible"):
        attack(scene, mask, [aside], DETECTOR, hide(), render=blobs)


def test_the_visible_part_of_an_object_excludes_what_hides_it() -> None:
    scene, mask = toy_scene()
    part = GaussianSubset.of(scene, mask)
    weight = visible_weight(part, camera(), blobs)
    assert float(weight.max()) <= 1
    box = visible_box(weight)
    assert box is not None
    assert 8 <= float(box[2] - box[0]) <= 28
    assert visible_box(torch.zeros(4, 4)) is None
    # The fake renderer averages: a second object in the same place takes half of every pixel.
    twin = merge(scene, scene.select(mask))
    shared = visible_weight(GaussianSubset.of(twin, slice(10, 40)), camera(), blobs)
    middle = weight > 0.99
    assert float(shared[middle].mean()) == pytest.approx(0.5, abs=0.01)


def test_clamped_colours_are_counted() -> None:
    scene, mask = toy_scene()
    assert clamped_fraction(GaussianSubset.of(scene, mask), camera()) == 0.0
    half = scene.sh.clone()
    half[:, 0, 0] = -9.0
    fraction = clamped_fraction(GaussianSubset.of(scene.replace(sh=half), mask), camera())
    assert fraction == pytest.approx(1 / 3)


def test_image_change_of_known_pictures() -> None:
    before = torch.zeros(4, 5, 3)
    after = before.clone()
    after[1, 2, 0] = 0.5
    weight = torch.zeros(4, 5)
    weight[1, 2] = 1.0
    change = image_change([before], [after], [weight])
    assert change.l2 == pytest.approx(0.5)
    assert change.linf == pytest.approx(0.5)
    assert change.psnr == pytest.approx(-10 * math.log10(0.25 / 60))
    assert change.psnr_object == pytest.approx(-10 * math.log10(0.25 / 3))
    assert change.outside == 0.0
    assert image_change([before], [after], [torch.zeros(4, 5)]).outside == pytest.approx(0.5)
    assert image_change([before], [before], [weight]).psnr is None


def test_eight_bits_there_and_back() -> None:
    picture = torch.rand(7, 5, 3) * 1.4 - 0.2
    assert torch.equal(through_png(picture), quantise(picture).float())
    assert torch.equal(quantise(quantise(picture)), quantise(picture))


def test_gradients_pass_the_clamp_only_inwards() -> None:
    from attacks.dagger.problem import _bounded

    image = torch.tensor([-0.5, -0.5, 0.5, 1.5, 1.5], requires_grad=True)
    bounded = _bounded(image)
    assert bounded.tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
    (gradient,) = torch.autograd.grad(bounded, [image], torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0]))
    assert gradient.tolist() == [0.0, -1.0, 1.0, 1.0, 0.0]


def test_scenes_on_another_dtype_work_too() -> None:
    scene, mask = toy_scene()
    wide = GaussianScene(*(value.double() for value in scene.tensors()))
    wide = wide.replace(rotations=torch.nn.functional.normalize(wide.rotations, dim=-1))
    part = GaussianSubset.of(wide, mask)
    parameters = part.parameters(("sh", "scales"))
    assert all(value.dtype == torch.float64 for value in parameters.values())
    torch.testing.assert_close(part.scene_with(parameters).scales, wide.scales)
