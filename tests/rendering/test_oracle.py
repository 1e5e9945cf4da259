"""The float64 oracle against central differences and against facts that can be written
down.
"""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from mi_splat import oracle
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cli.conform_pack import camera_of
from mi_splat.conformance import assert_renders_like_3dgs, random_splat
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene
from tests.rendering.test_rasterization import BACKGROUND, camera

STEP = 1e-6
SMALL = camera(23, 17)


def test_importing_the_oracle_needs_numpy_alone() -> None:
    heavy = "torch", "mitsuba", "drjit", "scipy", "polars", "PIL"
    code = (
        f"import sys, mi_splat.conformance; print([name for name in {heavy} if name in"
        " sys.modules])"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "[]\n"
    )


@pytest.mark.parametrize(
    "choices",
    [{}, {"compensated": True}, {"clamp": "none"}, {"clamp": "outside 0 to 1"}],
)
def test_gradients_are_central_differences(choices: dict[str, Any]) -> None:
    splat = random_splat(25, degree=2, seed=11)
    rng = np.random.default_rng(0)
    on_image = rng.normal(size=(17, 23, 3))
    on_alpha = rng.normal(size=(17, 23))
    on_depth = rng.normal(size=(17, 23))
    convention = oracle.Convention(**choices)
    splat = splat._replace(sh=splat.sh * 4)  # so that some colours are clamped

    def loss(moved: oracle.Splat) -> float:
        image, alpha, depth, _ = oracle.render(
            moved, SMALL, background=BACKGROUND, convention=convention
        )
        return float(
            (image * on_image).sum()
            + (alpha * on_alpha).sum()
            + (depth * on_depth).sum()
        )

    found = oracle.gradients(
        splat,
        SMALL,
        on_image,
        on_alpha,
        on_depth,
        background=BACKGROUND,
        convention=convention,
    )
    for name in ATTRIBUTES:
        gradient = getattr(found, name).ravel()
        values = getattr(splat, name)
        for entry in np.argsort(-np.abs(gradient))[:6]:
            ends = []
            for step in (STEP, -STEP):
                moved = values.copy()
                moved.reshape(-1)[entry] += step
                ends.append(loss(splat._replace(**{name: moved})))
            assert gradient[entry] == pytest.approx(
                (ends[0] - ends[1]) / (2 * STEP), rel=1e-6
            ), name


def test_a_right_renderer_passes_and_wrong_ones_are_named() -> None:
    render = Renderer()

    def ours(splat: oracle.Splat, view: oracle.PinholeCamera) -> Tensor:
        return render(GaussianScene(*map(torch.from_numpy, splat)), camera_of(view))

    assert_renders_like_3dgs(ours, tolerance=1e-5)
    with pytest.raises(
        AssertionError,
        match=(
            r"150 Gaussians of SH degree 0 .*: expected differences up to 0.0001, got"
        ),
    ):
        assert_renders_like_3dgs(
            lambda splat, view: (
                oracle.render(
                    splat, view, convention=oracle.Convention(low_pass=0.0)
                ).image
            )
        )
    with pytest.raises(AssertionError, match=r"SH degree 1 from a distance of 3.0"):
        assert_renders_like_3dgs(
            lambda splat, view: (
                oracle.render(
                    splat, view, convention=oracle.Convention(sh_degree=0)
                ).image
            )
        )
    with pytest.raises(
        AssertionError, match=r"expected an image \(43, 61, 3\), got \(61, 43, 3\)"
    ):
        assert_renders_like_3dgs(
            lambda splat, view: oracle.render(splat, view).image.transpose(1, 0, 2)
        )
