"""Median colours without some of the cameras."""

import torch
from torch import Tensor

from mi_splat.maths.medians import medians_without


def one_by_one(colours: Tensor, seen: Tensor, inside: Tensor) -> Tensor:
    """(P, 3) the same for one set of cameras that are left out, point by point."""
    found = torch.empty(len(colours), 3)
    for point, (values, counts) in enumerate(zip(colours, seen, strict=True)):
        others = counts & ~inside
        if int(others.sum()) < 2:
            others = ~inside
        found[point] = values[others].median(0).values
    return found


def test_medians_are_those_of_the_cameras_that_are_left() -> None:
    generator = torch.Generator().manual_seed(5)
    # rounded, so that many are equal
    colours = torch.rand(60, 11, 3, generator=generator).mul(8).round()
    seen = torch.rand(60, 11, generator=generator) < 0.5
    insides = torch.rand(7, 11, generator=generator) < 0.4
    found = medians_without(colours, seen, insides)
    for inside, medians in zip(insides, found, strict=True):
        torch.testing.assert_close(medians, one_by_one(colours, seen, inside))


def test_a_point_that_only_cameras_inside_see_has_the_median_of_the_others() -> None:
    colours = torch.arange(15.0).reshape(1, 5, 3)
    seen = torch.tensor([[True, True, False, False, False]])
    insides = torch.tensor([[True, True, False, False, False]])
    found = medians_without(colours, seen, insides)
    torch.testing.assert_close(found[0], colours[:, 3])
