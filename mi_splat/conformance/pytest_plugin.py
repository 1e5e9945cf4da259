"""For pytest: a test that requests `conforms_to_3dgs` calls it with a function that
renders a scene, and fails with the report where an image differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from numpy.typing import ArrayLike

from mi_splat.conformance.capabilities import not_applicable
from mi_splat.conformance.comparison import compare
from mi_splat.conformance.scenes import SIZES, conformance_scenes
from mi_splat.conformance.setups import Setup

RenderScene = Callable[[Setup], ArrayLike]


@pytest.fixture
def conforms_to_3dgs() -> Callable[..., None]:
    """Check a renderer, see `check`."""
    return check


def check(
    render: RenderScene,
    *,
    profile: str = "3dgs",
    accept: Iterable[str] = (),
    cannot: Iterable[str] = (),
) -> None:
    """Hold a renderer to the references of all scenes that are not left out.

    Args:
        render: Takes a scene with `splat`, `camera` and `background`, and returns its
            image (H, W, 3): bytes, or floats in 0 to 1.
        profile: What the renderer is meant to be, as for `compare`.
        accept: What it is meant to do otherwise, and scenes to leave out.
        cannot: What it is not able to do, as for `compare`.

    Raises:
        AssertionError: An image differs; the message is the report.
    """
    accepted = tuple(accept)
    lacking = tuple(cannot)
    setups = {scene.name: scene.setup for scene in conformance_scenes(SIZES[0])}
    left_out = {*accepted, *not_applicable(setups, lacking)}
    images = {
        name: np.asarray(render(setup))
        for name, setup in setups.items()
        if name not in left_out
    }
    report = compare(images, profile, accepted, lacking)
    if not report.conforms:
        raise AssertionError(f"\n{report}")
