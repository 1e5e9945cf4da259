"""One object of a scene as raw parameters: named in any way, and back without a changed bit elsewhere."""

from __future__ import annotations

import pytest
import torch

from attacks.gaussian_subset import GaussianSubset
from mi_splat.errors import InvalidValueError
from mi_splat.scene import GaussianScene
from tests.fakes import toy_scene


def test_the_object_may_be_named_by_mask_rows_or_slice() -> None:
    scene, mask = toy_scene()
    names = (mask, torch.nonzero(mask)[:, 0].flip(0), slice(10, 40))
    for name in names:
        assert GaussianSubset.of(scene, name).rows.tolist() == list(range(10, 40))
    with pytest.raises(InvalidValueError, match=r"mask: expected shape \(40,\)"):
        GaussianSubset.of(scene, mask[:-1])
    with pytest.raises(InvalidValueError, match="mask: expected at least one Gaussian"):
        GaussianSubset.of(scene, torch.zeros(40, dtype=torch.bool))
    with pytest.raises(InvalidValueError, match="mask: expected bool values or indices"):
        GaussianSubset.of(scene, torch.tensor([40]))


def test_scenes_on_another_dtype_work_too() -> None:
    scene, mask = toy_scene()
    wide = GaussianScene(*(value.double() for value in scene.tensors()))
    wide = wide.replace(rotations=torch.nn.functional.normalize(wide.rotations, dim=-1))
    subset = GaussianSubset.of(wide, mask)
    parameters = subset.parameters(("sh", "scales"))
    assert all(value.dtype == torch.float64 for value in parameters.values())
    torch.testing.assert_close(subset.scene_with(parameters).scales, wide.scales)


@pytest.mark.parametrize("rows", [torch.tensor([40]), torch.tensor([-1]), torch.tensor([0.0])])
def test_rows_outside_the_scene_are_refused(rows: torch.Tensor) -> None:
    with pytest.raises(InvalidValueError, match=r"mask: expected bool values or indices in 0\.\.39"):
        GaussianSubset.of(toy_scene()[0], rows)


def test_raw_parameters_are_those_of_a_file() -> None:
    scene, mask = toy_scene()
    clean = GaussianSubset.of(scene, mask).clean
    torch.testing.assert_close(clean["scales"], scene.scales[mask].log())
    torch.testing.assert_close(clean["opacities"], torch.logit(scene.opacities[mask]))
    for name in ("means", "rotations", "sh"):
        assert torch.equal(clean[name], getattr(scene, name)[mask])


def test_what_does_not_move_keeps_its_bits_and_what_moves_is_counted() -> None:
    scene, mask = toy_scene()
    scene = scene.replace(scales=scene.scales + 0.1 * torch.rand(40, 3), opacities=torch.rand(40))
    subset = GaussianSubset.of(scene, mask)
    still = subset.applied(subset.parameters(("scales", "rotations", "opacities")))
    for before, after in zip(scene.tensors(), still.tensors(), strict=True):
        assert torch.equal(before, after)
    assert subset.changed(still) == 0
    moved = subset.parameters(("rotations", "opacities"))
    moved = {name: value.clone() for name, value in moved.items()}
    moved["rotations"][3, 0] += 0.5  # normalisation moves the other three as well
    moved["opacities"][4] += 0.5
    applied = subset.applied(moved)
    differs = (applied.rotations != scene.rotations).any(1) | (applied.opacities != scene.opacities)
    assert torch.nonzero(differs)[:, 0].tolist() == [13, 14]
    assert subset.changed(applied) == 2
    torch.testing.assert_close(applied.rotations.norm(dim=1), torch.ones(40))
    expected = torch.sigmoid(torch.logit(scene.opacities[14]) + 0.5)
    torch.testing.assert_close(applied.opacities[14], expected)


def test_gradients_reach_the_parameters_of_the_object_alone() -> None:
    scene, mask = toy_scene()
    subset = GaussianSubset.of(scene, mask)
    leaf = subset.parameters(("scales",))["scales"].requires_grad_(True)
    changed = subset.scene_with({"scales": leaf})
    (gradient,) = torch.autograd.grad(changed.scales.sum(), [leaf])
    torch.testing.assert_close(gradient, scene.scales[mask])  # d exp(x) / dx
    assert not changed.means.requires_grad
