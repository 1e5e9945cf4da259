"""Scenes moved, turned and resized: covariances and colours go with them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError
from mi_splat.rotation import from_matrix, normalise, to_matrix
from mi_splat.scene import GaussianScene, Similarity, scene_hash
from mi_splat.sh import coefficient_count, sh_to_colour
from tests.gaussians import random_scene


def turn(seed: int) -> Tensor:
    quaternion = torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return to_matrix(normalise(quaternion))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_transform_moves_covariances_and_colours_with_the_scene(degree: int, seed: int) -> None:
    scene = random_scene(20, degree, seed=seed, dtype=torch.float64)
    similarity = Similarity(turn(seed), torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64), 1.7)
    moved = scene.transform(similarity)
    linear = similarity.scale * similarity.rotation
    torch.testing.assert_close(moved.means, scene.means @ linear.T + similarity.translation)

    def covariance(of: GaussianScene) -> Tensor:
        axes = to_matrix(of.rotations) * of.scales[:, None, :]
        return axes @ axes.mT

    torch.testing.assert_close(covariance(moved), linear @ covariance(scene) @ linear.T)
    camera = torch.tensor([5.0, 4.0, -3.0], dtype=torch.float64)
    before = torch.nn.functional.normalize(scene.means - camera, dim=1)
    after = torch.nn.functional.normalize(moved.means - (linear @ camera + similarity.translation), dim=1)
    torch.testing.assert_close(sh_to_colour(moved.sh, after), sh_to_colour(scene.sh, before))
    assert torch.equal(moved.opacities, scene.opacities)


def test_transform_by_a_translation_alone_changes_means_alone() -> None:
    scene = random_scene(50)
    moved = scene.transform(Similarity(torch.eye(3), torch.ones(3)))
    assert torch.equal(moved.means, scene.means + 1)
    assert scene_hash(moved.replace(means=scene.means)) == scene_hash(scene)


def test_transforms_compose_and_can_be_undone() -> None:
    scene = random_scene(30, dtype=torch.float64)
    zero = torch.zeros(3, dtype=torch.float64)
    once = scene.transform(Similarity(turn(1), zero)).transform(Similarity(turn(2), zero))
    twice = scene.transform(Similarity(turn(2) @ turn(1), zero))
    for one, two in zip(once.tensors(), twice.tensors(), strict=True):
        sign = torch.sign((one * two).sum(1, keepdim=True)) if one is once.rotations else 1
        torch.testing.assert_close(one * sign, two)
    back = once.transform(Similarity((turn(2) @ turn(1)).T, zero))
    torch.testing.assert_close(back.sh, scene.sh)
    torch.testing.assert_close(back.means, scene.means)


def test_transform_is_differentiable() -> None:
    scene = random_scene(3, 2, dtype=torch.float64)
    similarity = Similarity(turn(3), torch.ones(3, dtype=torch.float64), 0.5)

    def move(*leaves: Tensor) -> tuple[Tensor, ...]:
        return GaussianScene.unchecked(*leaves).transform(similarity).tensors()

    leaves = [value.clone().requires_grad_() for value in scene.tensors()]
    assert torch.autograd.gradcheck(move, leaves)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rotation": torch.eye(4)}, "rotation"),
        ({"rotation": 2 * torch.eye(3)}, "rotation"),
        ({"rotation": torch.diag(torch.tensor([1.0, 1.0, -1.0]))}, "rotation"),
        ({"rotation": torch.full((3, 3), float("nan"))}, "rotation"),
        ({"translation": torch.zeros(2)}, "translation"),
        ({"translation": torch.tensor([0.0, 0.0, float("inf")])}, "translation"),
        ({"scale": 0.0}, "scale"),
        ({"scale": -1.0}, "scale"),
        ({"scale": float("nan")}, "scale"),
    ],
)
def test_similarity_refuses_what_is_none(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidValueError, match=f"^{words}: expected"):
        Similarity(**{"rotation": torch.eye(3), "translation": torch.zeros(3), **change})


def test_spinning_a_scene_spins_its_quaternions() -> None:
    scene = random_scene(1, dtype=torch.float64).replace(rotations=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64))
    spun = scene.transform(Similarity(turn(4), torch.zeros(3, dtype=torch.float64)))
    torch.testing.assert_close(spun.rotations[0], from_matrix(turn(4)))
    assert spun.sh.shape[1] == coefficient_count(3)
