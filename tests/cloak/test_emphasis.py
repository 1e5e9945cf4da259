"""An appearance that is overdone near the edge of its trigger."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from attacks.cloak.appearances import Emphasis
from attacks.cloak.triggers import Elevation
from mi_splat.camera_sets import orbit
from mi_splat.cameras import View

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
