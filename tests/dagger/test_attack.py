"""DAGGER on fakes: a table of attacks, what may not move, budgets, controls and
warnings.
"""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks import cli
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.result import Result, observed
from attacks.objectives.base import Objective
from attacks.objectives.relabel import relabel
from attacks.objectives.suppression import hide, untargeted
from attacks.observe import Control
from attacks.observe.rows import NOISE
from attacks.optimisers import NORM_NAMES, NormName
from attacks.search.budget import NORMS
from mi_splat.attributes import ATTRIBUTES, Attribute
from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.images import through_png
from mi_splat.io.parsing import read_json
from mi_splat.render import variant
from mi_splat.scene import GaussianScene
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
    (
        ("sh", "means", "scales", "rotations", "opacities"),
        (5.0, 1.0, 1.0, 0.5, 1.0),
        "l2",
        untargeted(),
    ),
]


def run(
    objective: Objective | None = None,
    *,
    cameras: list[Camera] | None = None,
    **settings: Any,
) -> Result:
    scene, mask = toy_scene()
    config = DaggerConfig(**{"eps": (12.0,), **settings})
    views = [camera()] if cameras is None else cameras
    return attack(
        scene,
        mask,
        views,
        DETECTOR,
        objective or relabel("person"),
        render=blobs,
        config=config,
    )


@pytest.mark.parametrize(("attributes", "eps", "norm", "objective"), TABLE)
def test_attack_table(
    attributes: tuple[Attribute, ...],
    eps: tuple[float, ...],
    norm: NormName,
    objective: Objective,
) -> None:
    scene, mask = toy_scene()
    scene = scene.with_degree(3) if "sh" in attributes else scene
    result = run(objective, attributes=attributes, eps=eps, norm=norm)
    assert min(line.loss for line in result.trace) < result.trace[0].loss
    if attributes != ("rotations",):  # turning round blobs changes next to nothing
        assert result.success, result.trace
        # Noise that changes the image as much may well hide blobs, and noise of
        # opacities cannot remove them all.
        assert attributes != ("sh",) or not result.warnings
        assert all(
            warning.startswith(("a random change (noise)", "draw "))
            for warning in result.warnings
        )
    for name, radius in zip(attributes, eps, strict=True):
        assert 0 < result.used[name] <= radius
    for attribute in ATTRIBUTES:
        before = getattr(scene, attribute)
        after = getattr(result.scene, attribute)
        assert torch.equal(before[~mask], after[~mask])
        assert torch.equal(before, after) == (attribute not in attributes)
    assert 0 < result.changed_gaussians <= result.object_gaussians == int(mask.sum())
    if attributes == ("sh",):
        assert result.figures.rate("reached", splat=NOISE).successes == 0


def test_noise_changes_the_object_as_much_as_the_attack() -> None:
    names: tuple[Control, ...] = ("noise", "smooth-noise", "norm-noise")
    result = run(controls=names, noise_draws=2, cameras=[camera(), camera(offset=0.4)])
    assert list(result.control_images) == [
        (name, draw) for name in names for draw in range(2)
    ]
    attacked = result.image.psnr_object
    assert attacked is not None
    for (name, _), change in result.control_images.items():
        assert change.psnr_object is not None
        if name == "norm-noise":
            # as large in the file, and averaged out in the image
            assert change.psnr_object > attacked + 6
        else:
            assert abs(change.psnr_object - attacked) < 1.0
    for name in names:
        assert result.figures.rate("success", splat=name).total == 4
    assert set(observed(result.views, result.objective).rows["splat"].unique()) == {
        "clean",
        "attacked",
        *names,
    }


def test_the_attacked_file_has_the_coefficients_of_3dgs_unless_told_otherwise() -> None:
    scene, mask = toy_scene()
    result = run()
    plain = run(sh_degree=None)
    assert result.scene.degree == 3
    assert plain.scene.degree == 1
    assert torch.equal(result.scene.sh[~mask], scene.with_degree(3).sh[~mask])
    assert result.changed_gaussians <= int(mask.sum())
    # a longer basis vector, so more colour for the same budget
    assert result.image.l2 > plain.image.l2
    assert result.origin["scene_hash"] == plain.origin["scene_hash"]
    config = DaggerConfig(noise_draws=0, steps=1)
    second = attack(
        scene.with_degree(2),
        mask,
        [camera()],
        DETECTOR,
        hide(),
        render=blobs,
        config=config,
    )
    assert second.scene.degree == 3
    assert run(hide(), attributes=("opacities",), eps=(1.0,)).scene.degree == 1


def test_a_zero_budget_changes_no_bit() -> None:
    scene, _ = toy_scene()
    everything: tuple[Attribute, ...] = (
        "means",
        "scales",
        "rotations",
        "opacities",
        "sh",
    )
    result = run(attributes=everything, eps=(0.0,) * 5, sh_degree=None)
    for before, after in zip(scene.tensors(), result.scene.tensors(), strict=True):
        assert torch.equal(before, after)
    assert result.changed_gaussians == 0
    assert not result.success
    assert result.image.psnr is None
    assert f"{result.image}" == "no pixel changed"
    assert "the loss did not fall" in result.warnings


def test_the_result_is_judged_on_the_saved_file(tmp_path: Path) -> None:
    result = run()
    save_splat(result.scene, tmp_path / "attacked.ply")
    picture = through_png(blobs(load_splat(tmp_path / "attacked.ply"), camera()))
    assert torch.equal(picture, result.views[0].attacked.image)
    seen = DETECTOR.detect(picture[None])[0]
    assert seen.labels == result.views[0].attacked.detections.labels
    assert result.target_confidence == pytest.approx(
        float(seen.scores[seen.labels.index("person")])
    )


def test_what_the_file_loses_the_attack_loses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The verdict, the images and `used_in_file` are of the scene that comes back
    from the file.
    """
    clean = toy_scene()[0].with_degree(3)
    monkeypatch.setattr("attacks.dagger.attack.as_saved", lambda scene: clean)
    result = run()
    assert result.best.success
    assert not result.success
    assert torch.equal(result.views[0].attacked.image, result.views[0].clean.image)
    assert result.used["sh"] > result.used_in_file["sh"] == 0.0


def test_it_is_deterministic_and_the_seed_moves_only_what_is_random() -> None:
    runs = [run(restarts=2, early_stop=False, seed=seed) for seed in (3, 3, 4)]
    assert runs[0].trace == runs[1].trace
    assert torch.equal(runs[0].scene.sh, runs[1].scene.sh)
    first = [line for line in runs[0].trace if line.restart == 0]
    assert first == [line for line in runs[2].trace if line.restart == 0]
    assert runs[0].trace != runs[2].trace


def test_views_are_attacked_in_turn_each_from_where_the_one_before_has_ended() -> None:
    views = [camera(), camera(offset=2.5)]
    result = run(cameras=views, sequential=True)
    alone = run(cameras=views[:1])
    assert result.trace[: len(alone.trace)] == alone.trace
    assert result.trace[len(alone.trace)].index == 0
    assert result.views[-1].attacked.verdict.success


def test_the_search_can_look_at_the_object_alone_and_is_judged_in_the_scene() -> None:
    result = run(isolated=True)
    assert result.success
    assert result.trace[0].loss != run().trace[0].loss
    assert torch.equal(result.views[0].clean.image, run().views[0].clean.image)


class Recorder:
    """Renders, and remembers how far the object's raw SH were from the clean ones in
    each image.
    """

    def __init__(self) -> None:
        scene, mask = toy_scene()
        self.clean = scene.with_degree(3).sh[mask].double()
        self.mask, self.deltas = mask, list[Tensor]()

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        if scene.degree == 3:
            self.deltas.append(scene.sh[self.mask].detach().double() - self.clean)
        return blobs(scene, camera)


def recorded(**settings: Any) -> tuple[Result, list[Tensor], list[Tensor]]:
    """An attack, and the perturbations of its search and of its noise control, as they
    were rendered.
    """
    scene, mask = toy_scene()
    record = Recorder()
    config = DaggerConfig(controls=("norm-noise",), **settings)
    result = attack(
        scene,
        mask,
        [camera()],
        DETECTOR,
        relabel("person"),
        render=record,
        config=config,
    )
    # After the search come the judge's; the clean scene has images of degree 1, the
    # object's weight of degree 0.
    points = record.deltas[: len(result.trace)]
    noise = record.deltas[len(result.trace) + 1 :]
    assert len(noise) == config.noise_draws
    return result, points, noise


def test_steps_are_as_long_as_the_paper_s() -> None:
    """Eleven of 2 eps / 11 in the l2 norm over the object: the first five end inside
    the ball of radius 5.
    """
    _, points, _ = recorded(early_stop=False, noise_draws=0)
    assert len(points) == 12
    assert float(points[0].norm()) == 0.0
    lengths = [float((b - a).norm()) for a, b in itertools.pairwise(points)]
    assert lengths[:5] == pytest.approx([2 * 5 / 11] * 5, rel=1e-4)
    assert max(float(point.norm()) for point in points) <= 5.0


@pytest.mark.parametrize("norm", NORM_NAMES)
def test_noise_has_the_size_of_the_attack_in_its_norm(norm: NormName) -> None:
    result, _, noise = recorded(norm=norm, eps=(2.0,), noise_draws=3)
    sizes = [NORMS[norm].measure(delta) for delta in noise]
    assert sizes == pytest.approx([result.used["sh"]] * 3, rel=1e-5)
    directions = torch.stack([delta.flatten() / delta.norm() for delta in noise])
    # draws of their own
    assert float((directions @ directions.T).fill_diagonal_(0).abs().max()) < 0.2


def test_wrong_arguments_say_what_is_wrong() -> None:
    scene, mask = toy_scene()
    with pytest.raises(
        InvalidValueError,
        match="target: expected one of car, person, stop sign, got tram",
    ):
        attack(scene, mask, [camera()], DETECTOR, relabel("tram"), render=blobs)
    with pytest.raises(
        InvalidValueError, match="cameras: expected at least one camera"
    ):
        attack(scene, mask, [], DETECTOR, hide(), render=blobs)
    away = dataclasses.replace(camera(), to_world=camera(offset=200.0).to_world)
    lens = dataclasses.replace(away.lens, principal=(-500.0, 16.0))
    aside = dataclasses.replace(away, lens=lens)
    with pytest.raises(
        InvalidValueError,
        match="camera: expected a view in which the object is visible",
    ):
        attack(scene, mask, [aside], DETECTOR, hide(), render=blobs)


@pytest.mark.skipif(
    not (variant.has_cuda() and torch.cuda.is_available()), reason="needs a GPU"
)
@pytest.mark.parametrize(
    "words", ["dagger", "dagger --region --held-out 4 --validation 2"]
)
def test_a_gpu_finds_nearly_the_same_losses(words: str, tmp_path: Path) -> None:
    losses = []
    for device in ("cpu", "cuda"):
        out = tmp_path / device
        try:
            assert (
                cli.main(
                    [
                        *words.split(),
                        "example:car_street",
                        "--steps",
                        "3",
                        "--device",
                        device,
                        "--out",
                        str(out),
                    ]
                )
                == 0
            )
        finally:
            variant.use("llvm_ad_rgb")
        losses.append(
            [line["loss"] for line in read_json(out / "result.json")["trace"]]
        )
    assert losses[0] == pytest.approx(losses[1], rel=0.1)
