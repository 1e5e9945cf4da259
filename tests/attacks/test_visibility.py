"""Where an object shows, how much of its colour is clamped, and how far pictures are apart."""

from __future__ import annotations

import math

import pytest
import torch

from attacks.gaussian_subset import GaussianSubset
from attacks.observe.views import clamped_fraction, image_change, visible_box, visible_weight
from mi_splat.io.images import quantise, through_png
from mi_splat.scene import merge
from mi_splat.sh import sh_basis
from tests.fakes import blobs, camera, toy_scene


def test_the_visible_pixels_of_an_object_exclude_what_hides_it() -> None:
    scene, mask = toy_scene()
    weight = visible_weight(GaussianSubset.of(scene, mask), camera(), blobs)
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
    assert image_change([before], [after], [torch.zeros(4, 5)]).outside == pytest.approx(0.5)
    assert image_change([before], [after], [torch.full((4, 5), 0.01)]).outside == 0.0  # some of it is the object's
    assert image_change([before], [before], [weight]).psnr is None


def test_the_box_is_around_whole_pixels_of_at_least_half() -> None:
    weight = torch.zeros(8, 10)
    weight[2:5, 3:7] = 0.5
    weight[6, 9] = 0.49
    box = visible_box(weight)
    assert box is not None
    assert box.tolist() == [3.0, 2.0, 7.0, 5.0]


def test_eight_bits_there_and_back() -> None:
    picture = torch.rand(7, 5, 3) * 1.4 - 0.2
    assert torch.equal(through_png(picture), quantise(picture).float())
    assert torch.equal(quantise(quantise(picture)), quantise(picture))
