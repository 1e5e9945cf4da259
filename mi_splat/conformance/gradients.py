"""Whether a renderer's gradients are exact, and which terms its attributes lack."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.conformance.files import read_gradients
from mi_splat.conformance.scenes import SIZES, ConformanceScene, conformance_scenes
from mi_splat.conformance.setups import Setup
from mi_splat.oracle import (
    DEFAULT,
    Array,
    Convention,
    ProjectedGradients,
    Splat,
    attribute_gradients,
    gradients,
    project,
    projected_gradients,
)

TOLERANCE = 1e-3
"""Largest error, as a part of the length of the gradient. Where that is short, as where
the exact gradient is 0 and rounding is all there is, as a part of its median length
over all scenes where it is not 0.
"""
_NONE = 1e-9
ATTRIBUTES = Splat._fields

Gradients = Mapping[str, Array]


class GradientResult(NamedTuple):
    """The gradients of one scene."""

    name: str
    conforms: bool
    # by attribute; None where its array is missing or has another shape
    errors: dict[str, float | None]


class GradientCause(NamedTuple):
    """What explains the gradient of an attribute in every scene."""

    attribute: str
    text: str


@dataclass(frozen=True, kw_only=True)
class GradientReport:
    """How gradients compare with exact ones."""

    scenes: tuple[GradientResult, ...]
    causes: tuple[GradientCause, ...]
    # attributes that are off, and of which no cause is known
    unexplained: tuple[str, ...]
    missing: tuple[str, ...]  # scenes without gradients

    @property
    def conforms(self) -> bool:
        """Whether all gradients of all scenes are there and exact."""
        return not self.missing and all(row.conforms for row in self.scenes)

    def as_dict(self) -> dict[str, Any]:
        """The report for JSON."""
        return {
            "conforms": self.conforms,
            "gradients": [
                {
                    "name": row.name,
                    "conforms": row.conforms,
                    "relative_errors": row.errors,
                }
                for row in self.scenes
            ],
            "causes": [cause._asdict() for cause in self.causes],
            "unexplained": list(self.unexplained),
            "missing": list(self.missing),
        }

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """The report for a terminal."""
        lines = []
        for row in self.scenes:
            words = [f"{key} {_shown(error)}" for key, error in row.errors.items()]
            verdict = "conforms" if row.conforms else "differs"
            lines.append(f"{row.name:18}{verdict:10}{', '.join(words)}")
        count = sum(row.conforms for row in self.scenes)
        total = len(self.scenes) + len(self.missing)
        lines.append(f"{count} of {total} gradients conform.")
        if self.missing:
            lines.append(f"missing           {', '.join(self.missing)}")
        for cause in self.causes:
            lines.append(f"likely cause      {cause.attribute}: {cause.text}")
        if self.unexplained:
            lines.append(f"unexplained       {', '.join(self.unexplained)}")
        return lines


def _shown(error: float | None) -> str:
    if error is None:
        return "missing or of another shape"
    return f"{error:.2g}"


def compare_gradients(
    found: Mapping[str, Mapping[str, ArrayLike]] | str | PathLike[str],
    *,
    size: int = SIZES[0],
) -> GradientReport:
    """Compare the gradients of a renderer with exact ones.

    They are those of `sum(weights(camera) * image)` by the values (not the logarithms
    and logits) of the Gaussians of a scene, without rows that are not finite.

    Args:
        found: By scene the arrays `means` (N, 3), `scales` (N, 3), `rotations` (N, 4),
            `opacities` (N,) and `sh` (N, K, 3), or the folder that has them as
            NAME.npz.
        size: Pixels on each side of the images.

    Returns:
        The verdict, the errors and what explains them.

    Raises:
        InvalidValueError: The folder has no gradients, or a file that is no array.
    """
    scenes = {scene.name: scene for scene in conformance_scenes(size)}
    exact = {name: exact_gradients(scene.setup) for name, scene in scenes.items()}
    if isinstance(found, (str, PathLike)):
        given = read_gradients(found, exact)
    else:
        given = {
            name: {
                key: np.asarray(array, dtype=np.float64) for key, array in row.items()
            }
            for name, row in found.items()
            if name in exact
        }
    floors = {key: _median_length(exact.values(), key) for key in ATTRIBUTES}
    rows = []
    for name, arrays in given.items():
        errors = {
            key: _error(arrays.get(key), exact[name][key], floors[key])
            for key in ATTRIBUTES
        }
        good = all(
            error is not None and error <= TOLERANCE for error in errors.values()
        )
        rows.append(GradientResult(name, good, errors))
    wrong = [
        key
        for key in ATTRIBUTES
        if any((row.errors[key] or 0.0) > TOLERANCE for row in rows)
    ]
    causes = _causes(wrong, given, exact, scenes, floors)
    explained = {cause.attribute for cause in causes}
    return GradientReport(
        scenes=tuple(rows),
        causes=tuple(causes),
        unexplained=tuple(key for key in wrong if key not in explained),
        missing=tuple(name for name in scenes if name not in given),
    )


def weights(height: int, width: int) -> Array:
    """(H, W, 3) what the image is multiplied by before it is summed."""
    rows, columns, channels = np.ogrid[:height, :width, :3]
    found: Array = np.sin(rows + 2 * columns + 3 * channels)
    return found


def exact_gradients(setup: Setup) -> dict[str, Array]:
    """Derivatives of the weighted sum of an image by the name of the attribute."""
    camera = setup.camera
    on_image = weights(camera.height, camera.width)
    found = gradients(setup.splat, camera, on_image, background=setup.background)
    return found._asdict()


def _median_length(exact: Iterable[Gradients], key: str) -> float:
    lengths = [float(np.linalg.norm(found[key])) for found in exact]
    return float(np.median([length for length in lengths if length > _NONE]))


def _error(got: Array | None, exact: Array, floor: float) -> float | None:
    if got is None or got.shape != exact.shape:
        return None
    off = float(np.linalg.norm(got - exact))
    if not np.isfinite(off):
        return np.inf
    return off / max(float(np.linalg.norm(exact)), floor)


# ---------------------------------------------------------------------------- causes


def _parts(setup: Setup, *, through_limit: bool = False) -> ProjectedGradients:
    camera = setup.camera
    return projected_gradients(
        project(setup.splat, camera),
        camera,
        weights(camera.height, camera.width),
        background=setup.background,
        through_limit=through_limit,
    )


def _without(part: str) -> Callable[[Setup], Splat]:
    """Gradients by means that lack what goes through one property of Gaussians in the
    image.
    """

    def found(setup: Setup) -> Splat:
        parts = _parts(setup)
        exact = attribute_gradients(setup.splat, setup.camera, parts)
        rest = parts._replace(**{part: np.zeros_like(getattr(parts, part))})
        lacking = attribute_gradients(setup.splat, setup.camera, rest)
        return exact._replace(means=lacking.means)

    return found


def _with(convention: Convention) -> Callable[[Setup], Splat]:
    """Gradients by the attributes of another convention than that of the image."""
    return lambda setup: attribute_gradients(
        setup.splat, setup.camera, _parts(setup), convention
    )


def _through_limit(setup: Setup) -> Splat:
    parts = _parts(setup, through_limit=True)
    return attribute_gradients(setup.splat, setup.camera, parts)


def _detached_background(setup: Setup) -> Splat:
    parts = _parts(replace(setup, background=(0.0, 0.0, 0.0)))
    return attribute_gradients(setup.splat, setup.camera, parts)


def _stored_units(setup: Setup) -> Splat:
    """Gradients by the logarithms of scales and the logits of opacities."""
    splat = setup.splat
    exact = Splat(**exact_gradients(setup))
    return exact._replace(
        scales=exact.scales * splat.scales,
        opacities=exact.opacities * splat.opacities * (1 - splat.opacities),
    )


_MISTAKES: dict[str, Callable[[Setup], Splat]] = {
    "an alpha at its limit passes its gradient on": _through_limit,
    "a colour below 0 passes its gradient on": _with(replace(DEFAULT, clamp="none")),
    "the background is left out": _detached_background,
    "the direction in which SH are evaluated is left out": _without("colour"),
    "the covariance in the image is left out": _without("conic"),
    "the centre in the image is left out": _without("centre"),
    "the length of quaternions is not divided out": _with(
        replace(DEFAULT, unit_rotations=False)
    ),
    "by the logarithm or logit of the file, not by the value": _stored_units,
}


def _causes(
    wrong: list[str],
    given: Mapping[str, Gradients],
    exact: Mapping[str, Gradients],
    scenes: Mapping[str, ConformanceScene],
    floors: Mapping[str, float],
) -> list[GradientCause]:
    """What explains each attribute in every scene: a factor, or a known mistake."""

    @cache
    def made_by(mistake: str) -> dict[str, Gradients]:
        make = _MISTAKES[mistake]
        return {name: make(scenes[name].setup)._asdict() for name in given}

    causes = []
    for key in wrong:
        names = [name for name in given if _matches(given[name], exact[name], key)]
        factor = _factor([(given[name][key], exact[name][key]) for name in names])
        scaled = {name: {key: factor * exact[name][key]} for name in names}
        if _explains(key, scaled, given, floors):
            causes.append(GradientCause(key, _factor_text(factor)))
            continue
        for mistake in _MISTAKES:
            made = {name: made_by(mistake)[name] for name in names}
            if _explains(key, made, given, floors):
                causes.append(GradientCause(key, mistake))
                break
    return causes


def _factor_text(factor: float) -> str:
    if abs(factor) < TOLERANCE:
        return "it is 0"
    if abs(factor + 1) < TOLERANCE:
        return "its sign is wrong"
    return f"it is {factor:.4g} times too large"


def _matches(got: Gradients, exact: Gradients, key: str) -> bool:
    return key in got and got[key].shape == exact[key].shape


def _factor(pairs: list[tuple[Array, Array]]) -> float:
    """The factor of the exact gradients that fits best."""
    squares = sum(float((exact**2).sum()) for _, exact in pairs)
    products = sum(float((got * exact).sum()) for got, exact in pairs)
    return products / squares if squares else 0.0


def _explains(
    key: str,
    made: Mapping[str, Gradients],
    given: Mapping[str, Gradients],
    floors: Mapping[str, float],
) -> bool:
    """Whether gradients of a mistake are those given, in every scene."""
    errors = (_error(given[name][key], made[name][key], floors[key]) for name in made)
    return all(error is not None and error <= TOLERANCE for error in errors)
