"""Renderers in tests: random splats, and one assertion that compares with the
definition.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.conformance.setups import look_at
from mi_splat.oracle import DEFAULT, Convention, PinholeCamera, Splat, render


def random_splat(count: int, *, degree: int, seed: int) -> Splat:
    """Gaussians on a noisy unit sphere, among them needles, discs, huge and tiny ones,
    float64.
    """
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    means = (
        directions
        / np.linalg.norm(directions, axis=1, keepdims=True)
        * rng.uniform(0.7, 1.2, (count, 1))
    )
    scales = 0.06 * np.exp(rng.normal(size=(count, 3)) * 0.5)
    kind = rng.integers(0, 12, count)
    for number, factors in enumerate(
        ([20.0, 0.05, 0.05], [4.0, 4.0, 0.01], [0.02] * 3, [6.0] * 3)
    ):
        scales[kind == number] *= factors
    rotations = rng.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    opacities = np.where(kind == 4, 1.0, rng.uniform(0.0, 1.0, count))
    return Splat(
        means,
        scales,
        rotations,
        opacities,
        rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
    )


def assert_renders_like_3dgs(
    render_image: Callable[[Splat, PinholeCamera], ArrayLike],
    *,
    tolerance: float = 1e-4,
    sh_degree: int = 3,
    convention: Convention = DEFAULT,
) -> None:
    """Hold a renderer to the definition, for use in a test.

    Args:
        render_image: Takes float32 Gaussians and a camera, and returns (H, W, 3) on
            black.
        tolerance: Largest difference in any channel of any pixel; float32 renderers
            reach 1e-5.
        sh_degree: Highest degree that the renderer knows.
        convention: Choices that the renderer is meant to make.

    Raises:
        AssertionError: An image differs; says in which scene, where, and by how much.
    """
    for degree in range(sh_degree + 1):
        splat = Splat(
            *(
                value.astype(np.float32)
                for value in random_splat(150, degree=degree, seed=degree)
            )
        )
        for distance in (3.0, 0.5):  # from outside, and from within
            eye = distance * np.array([math.cos(degree), math.sin(degree), 0.4])
            camera = look_at(eye, (0, 0, 0), focal=58.0, width=61, height=43)
            camera = replace(camera, fy=52.0, cx=27.0)
            wanted = render(splat, camera, convention=convention).image
            got = np.asarray(render_image(splat, camera), dtype=np.float64)
            where = f"150 Gaussians of SH degree {degree} from a distance of {distance}"
            assert got.shape == wanted.shape, (
                f"{where}: expected an image {wanted.shape}, got {got.shape}"
            )
            error = np.abs(got - wanted).max(-1)
            row, column = np.unravel_index(np.argmax(error), error.shape)
            colours = (
                f"{wanted[row, column].round(4).tolist()}, got"
                f" {got[row, column].round(4).tolist()}"
            )
            at = (
                f"{error.max():.3g} at row {row}, column {column}, where the colour is"
                f" {colours}"
            )
            assert error.max() <= tolerance, (
                f"{where}: expected differences up to {tolerance:g}, got {at}"
            )
