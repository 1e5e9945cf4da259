"""Poison that is corrected by what a splat trained on it shows."""

from __future__ import annotations

import torch
from torch import Tensor

from attacks.cloak.appearances import Correction
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera, View

(CAMERA,) = orbit((0.0, 0.0, 0.0), count=1, elevation=30.0, distance=4.0, focal=20.0, size=(8, 8))
VIEW = View(CAMERA, torch.full((8, 8, 3), 0.5))
MASK = torch.zeros(8, 8, dtype=torch.bool)
MASK[2:4, 2:4] = True


def wanted(view: View, mask: Tensor) -> Tensor:
    return torch.where(mask[..., None], torch.tensor(0.2), view.image)


def blurred(camera: Camera) -> Tensor:
    """A splat that shows the half of what it should."""
    return torch.where(MASK[..., None], torch.tensor(0.35), torch.tensor(0.6))


def correction(earlier: object = wanted, *, gain: float = 1.0, reach: int | None = 1) -> Correction:
    return Correction(earlier=earlier, wanted=wanted, shown=blurred, gain=gain, reach=reach)  # type: ignore[arg-type]


def test_what_is_missing_is_added_within_reach_alone() -> None:
    image = correction(gain=0.5)(VIEW, MASK)
    assert torch.allclose(image[MASK], torch.tensor(0.2 - 0.5 * 0.15))
    assert torch.allclose(image[1, 1], torch.tensor(0.5 - 0.5 * 0.1))
    assert torch.equal(image[6:], VIEW.image[6:])


def test_without_a_reach_the_whole_picture_is_corrected() -> None:
    assert torch.allclose(correction(reach=None)(VIEW, MASK)[7, 7], torch.tensor(0.4))


def test_rounds_add_up_and_stay_in_range() -> None:
    twice = correction(correction())
    assert torch.allclose(twice(VIEW, MASK)[MASK], torch.tensor(0.0))  # 0.2 - 0.15 - 0.15, clipped
    assert "corrected by 1 times" in twice.name
    assert twice.name.count("corrected") == 2


def test_a_splat_that_shows_what_is_wanted_changes_nothing() -> None:
    right = Correction(earlier=wanted, wanted=wanted, shown=lambda camera: wanted(VIEW, MASK), gain=1.0, reach=None)
    assert torch.equal(right(VIEW, MASK), wanted(VIEW, MASK))
