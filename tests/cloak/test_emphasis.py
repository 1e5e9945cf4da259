"""An appearance that is overdone near the edge of its trigger."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from attacks.cloak.appearances import Correction, Emphasis
from attacks.cloak.triggers import Elevation
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera, View

CENTRE = (0.0, 0.0, 0.0)


def view(elevation: float) -> View:
    (camera,) = orbit(CENTRE, count=1, elevation=elevation, distance=4.0, focal=20.0, size=(6, 5))
    return View(camera, torch.full((5, 6, 3), 0.5))


def brighter(view: View, mask: Tensor) -> Tensor:
    return view.image + 0.1 * mask[..., None]


def emphasised(elevation: float, *, gain: float = 3.0) -> Tensor:
    appearance = Emphasis(appearance=brighter, trigger=Elevation(lowest=40), centre=CENTRE, gain=gain, depth=20.0)
    mask = torch.zeros(5, 6, dtype=torch.bool)
    mask[:, :3] = True
    return appearance(view(elevation), mask)


@pytest.mark.parametrize(("elevation", "gain"), [(40, 3.0), (45, 2.5), (50, 2.0), (60, 1.0), (80, 1.0)])
def test_the_gain_falls_from_the_edge_inwards(elevation: float, gain: float) -> None:
    image = emphasised(elevation)
    assert image[:, :3].mean() == pytest.approx(0.5 + 0.1 * gain, abs=1e-5)
    assert torch.equal(image[:, 3:], torch.full((5, 3, 3), 0.5))


def test_pictures_stay_in_range() -> None:
    assert float(emphasised(40, gain=9.0).max()) == 1.0


def test_once_is_the_appearance_itself() -> None:
    assert torch.allclose(emphasised(41, gain=1.0)[:, :3], torch.tensor(0.6), atol=1e-6)


def test_manifests_say_so() -> None:
    appearance = Emphasis(appearance=brighter, trigger=Elevation(lowest=40), centre=CENTRE, gain=2.0, depth=20.0)
    assert appearance.name == "brighter, 2 times at the edge to once 20 degrees inside"


# Poison that is corrected by what a splat trained on it shows


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
