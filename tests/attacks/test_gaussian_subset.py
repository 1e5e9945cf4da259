"""One object of a scene as raw parameters: named in any way, and back without a changed
bit elsewhere.
"""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from attacks.gaussian_subset import GaussianSubset
from attacks.observe.views import (
    clamped_fraction,
    image_change,
    visible_box,
    visible_weight,
)
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_png
from mi_splat.io.images import quantise, through_png, to_bytes
from mi_splat.io.picture_files import load_picture
from mi_splat.maths.sh import sh_basis
from mi_splat.scene import GaussianScene, merge
from tests.fakes import blobs, camera, toy_scene


def test_the_object_may_be_named_by_mask_rows_or_slice() -> None:
    scene, mask = toy_scene()
    names = (mask, torch.nonzero(mask)[:, 0].flip(0), slice(10, 40))
    for name in names:
        assert GaussianSubset.of(scene, name).rows.tolist() == list(range(10, 40))
    with pytest.raises(InvalidValueError, match=r"mask: expected shape \(40,\)"):
        GaussianSubset.of(scene, mask[:-1])
    with pytest.raises(InvalidValueError, match="mask: expected at least one Gaussian"):
        GaussianSubset.of(scene, torch.zeros(40, dtype=torch.bool))
    with pytest.raises(
        InvalidValueError, match="mask: expected bool values or indices"
    ):
        GaussianSubset.of(scene, torch.tensor([40]))


def test_scenes_on_another_dtype_work_too() -> None:
    scene, mask = toy_scene()
    wide = GaussianScene(*(value.double() for value in scene.tensors()))
    wide = wide.replace(rotations=torch.nn.functional.normalize(wide.rotations, dim=-1))
    subset = GaussianSubset.of(wide, mask)
    parameters = subset.parameters(("sh", "scales"))
    assert all(value.dtype == torch.float64 for value in parameters.values())
    torch.testing.assert_close(subset.scene_with(parameters).scales, wide.scales)


def test_raw_parameters_are_those_of_a_file() -> None:
    scene, mask = toy_scene()
    clean = GaussianSubset.of(scene, mask).clean
    torch.testing.assert_close(clean["scales"], scene.scales[mask].log())
    torch.testing.assert_close(clean["opacities"], torch.logit(scene.opacities[mask]))
    for name in ("means", "rotations", "sh"):
        assert torch.equal(clean[name], getattr(scene, name)[mask])


def test_what_does_not_move_keeps_its_bits_and_what_moves_is_counted() -> None:
    scene, mask = toy_scene()
    scene = scene.replace(
        scales=scene.scales + 0.1 * torch.rand(40, 3), opacities=torch.rand(40)
    )
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
    differs = (applied.rotations != scene.rotations).any(1) | (
        applied.opacities != scene.opacities
    )
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


# Where an object shows, how much of its colour is clamped, and how far images are
# apart


def test_the_visible_pixels_of_an_object_exclude_what_hides_it() -> None:
    scene, mask = toy_scene()
    weight = visible_weight(GaussianSubset.of(scene, mask), camera(), blobs)
    assert float(weight.max()) <= 1
    box = visible_box(weight)
    assert box is not None
    assert 8 <= float(box[2] - box[0]) <= 28
    assert visible_box(torch.zeros(4, 4)) is None
    # The fake renderer averages: a second object in the same place takes half of every
    # pixel.
    twin = merge(scene, scene.select(mask))
    shared = visible_weight(GaussianSubset.of(twin, slice(10, 40)), camera(), blobs)
    middle = weight > 0.99
    assert float(shared[middle].mean()) == pytest.approx(0.5, abs=0.01)


def test_a_colour_of_exactly_zero_counts_as_clamped() -> None:
    scene, mask = toy_scene()
    constant = float(sh_basis(torch.tensor([[0.0, 0.0, 1.0]]), 0))
    at_zero = -0.5 / constant
    assert 0.5 + torch.tensor(constant) * torch.tensor(at_zero) == 0.0
    sh = torch.zeros_like(scene.sh)
    sh[:, 0, 0] = at_zero
    fraction = clamped_fraction(GaussianSubset.of(scene.replace(sh=sh), mask), camera())
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
    assert image_change(
        [before], [after], [torch.zeros(4, 5)]
    ).outside == pytest.approx(0.5)
    # some of it is the object's
    assert image_change([before], [after], [torch.full((4, 5), 0.01)]).outside == 0.0
    assert image_change([before], [before], [weight]).psnr is None


def test_eight_bits_there_and_back(tmp_path: Path) -> None:
    picture = torch.rand(7, 5, 3) * 1.4 - 0.2
    save_png(to_bytes(picture), tmp_path / "picture.png")
    read = torch.from_numpy(
        np.asarray(load_picture(tmp_path / "picture.png").convert("RGB"), np.float32)
        / 255
    )
    assert torch.equal(through_png(picture), read)
    assert torch.equal(through_png(picture), quantise(picture).float())
    assert torch.equal(quantise(quantise(picture)), quantise(picture))
