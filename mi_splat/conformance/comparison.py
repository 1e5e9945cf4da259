"""Whether the images of a renderer are those of 3D Gaussian Splatting, and why not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.conformance.capabilities import not_applicable
from mi_splat.conformance.causes import Cause, find_causes, sampled
from mi_splat.conformance.deviations import DEVIATIONS, PROFILES, applied, of_profile
from mi_splat.conformance.files import FoundImage, as_image, read_images
from mi_splat.conformance.scenes import SIZES, ConformanceScene, conformance_scenes
from mi_splat.conformance.setups import Setup
from mi_splat.conformance.tolerances import (
    Error,
    Tolerance,
    difference,
    least_tolerance,
    tolerance_of,
)
from mi_splat.errors import InvalidValueError, nearest
from mi_splat.oracle import Array, Pixels


class SceneResult(NamedTuple):
    """The image of one scene."""

    name: str
    conforms: bool
    error: Error | None  # None where the image has another size
    tolerance: Tolerance
    size: tuple[int, int]  # width and height of the image, pixels

    @property
    def text(self) -> str:
        """How far it is off."""
        if self.error is None:
            return f"{self.size[0]} x {self.size[1]} pixels"
        return f"{self.error.psnr:.1f} dB, at most {self.error.largest:.3f}"


@dataclass(frozen=True, kw_only=True)
class Report:
    """How images compare with their references."""

    profile: str
    accepted: tuple[str, ...]  # deviations of the reference, and scenes left out
    scenes: tuple[SceneResult, ...]
    causes: tuple[Cause, ...]
    unexplained: tuple[str, ...]  # scenes that differ, and that no cause brings back
    missing: tuple[str, ...]  # scenes without an image
    # scenes that need what the renderer cannot do, with what they need
    not_applicable: Mapping[str, Sequence[str]]
    nearer: str | None  # another profile to which more images conform

    @property
    def conforms(self) -> bool:
        """Whether there is an image of every scene that applies, at least one, and each
        is within its tolerance.
        """
        complete = bool(self.scenes) and not self.missing
        return complete and all(row.conforms for row in self.scenes)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """The report for a terminal."""
        lines = []
        for row in self.scenes:
            verdict = "conforms" if row.conforms else "differs"
            lines.append(f"{row.name:18}{verdict:10}{row.text}")
        count = sum(row.conforms for row in self.scenes)
        total = len(self.scenes) + len(self.missing)
        lines.append(f"{count} of {total} images conform to {self.profile}.")
        if self.missing:
            lines.append(f"missing           {', '.join(self.missing)}")
        for name, needed in self.not_applicable.items():
            lines.append(f"not applicable    {name}: needs {', '.join(needed)}")
        for cause in self.causes:
            deviation = cause.deviation
            lines.append(
                f"likely cause      {deviation.key}: {deviation.text}"
                f" ({deviation.kind}; explains {', '.join(cause.scenes)})"
            )
        if self.unexplained:
            lines.append(f"unexplained       {', '.join(self.unexplained)}")
        if self.nearer is not None:
            lines.append(
                f"More images conform to the profile {self.nearer}: compare with it."
            )
        return lines

    def as_dict(self) -> dict[str, Any]:
        """The report for JSON."""
        return {
            "conforms": self.conforms,
            "profile": self.profile,
            "accepted": list(self.accepted),
            "scenes": [
                {
                    "name": row.name,
                    "conforms": row.conforms,
                    "size": list(row.size),
                    "psnr": row.error and row.error.psnr,
                    "largest": row.error and row.error.largest,
                    "tolerance": row.tolerance._asdict(),
                }
                for row in self.scenes
            ],
            "causes": [
                {
                    "key": cause.deviation.key,
                    "text": cause.deviation.text,
                    "kind": cause.deviation.kind,
                    "scenes": list(cause.scenes),
                }
                for cause in self.causes
            ],
            "unexplained": list(self.unexplained),
            "missing": list(self.missing),
            "not_applicable": {
                name: list(needed) for name, needed in self.not_applicable.items()
            },
            "nearer": self.nearer,
        }


def compare(
    images: Mapping[str, ArrayLike] | str | PathLike[str],
    profile: str = "3dgs",
    accept: Iterable[str] = (),
    cannot: Iterable[str] = (),
) -> Report:
    """Compare the images of a renderer with the reference.

    Args:
        images: By the name of their scene, (H, W, 3) in sRGB, or (H, W, 4) with an
            alpha: bytes, or floats in 0 to 1 that are multiplied by their alpha. Or the
            folder that has them as NAME.png or NAME.npy.
        profile: What the renderer is meant to be, one of `PROFILES`.
        accept: What it is meant to do otherwise, keys of `DEVIATIONS`, which the
            reference then does too; and names of scenes to leave out.
        cannot: What it is not able to do, keys of `CAPABILITIES` such as "off-centre".
            Scenes that need it are not applicable: neither missing nor conforming.

    Returns:
        The verdict, the errors, and what explains them.

    Raises:
        InvalidValueError: There is no image of a scene, a file is none, images have a
            size that no reference has, or a profile, a deviation or a capability is not
            known.
    """
    names = [scene.name for scene in conformance_scenes(SIZES[0])]
    if isinstance(images, (str, PathLike)):
        given = read_images(images, names)
    else:
        given = {
            name: as_image(np.asarray(images[name]), name)
            for name in names
            if name in images
        }
    scenes = {scene.name: scene for scene in scenes_for(given)}
    setups = {name: scene.setup for name, scene in scenes.items()}
    return compare_setups(given, setups, profile=profile, accept=accept, cannot=cannot)


def scenes_for(images: Mapping[str, FoundImage]) -> list[ConformanceScene]:
    """The scenes at the size that most images have."""
    if not images:
        raise InvalidValueError.of(
            "images", "some by the name of a scene", "none", "see conformance_scenes()"
        )
    heights = [len(image.values) for image in images.values()]
    height = max(set(heights), key=heights.count)
    if height not in SIZES:
        expected = ", ".join(map(str, SIZES))
        raise InvalidValueError.of(
            "images",
            f"{expected} pixels on each side",
            f"{height} rows",
            "render the splats with the cameras of the pack",
        )
    return conformance_scenes(height)


def compare_setups(
    images: Mapping[str, FoundImage],
    setups: Mapping[str, Setup],
    *,
    profile: str = "3dgs",
    accept: Iterable[str] = (),
    cannot: Iterable[str] = (),
    advance: Callable[[str], None] = lambda _: None,
) -> Report:
    """Compare images with the references of setups, see `compare`.

    Args:
        images: By the name of their scene.
        setups: Of every scene, before the profile.
        profile: See `compare`.
        accept: See `compare`.
        cannot: See `compare`.
        advance: Called with what is done next.
    """
    accepted = tuple(accept)
    for key in accepted:
        if key not in DEVIATIONS and key not in setups:
            do = nearest(key, [*DEVIATIONS, *setups], "see the list of the page")
            raise InvalidValueError.of(
                "accept", "a deviation such as order=distance, or a scene", key, do
            )
    kept = {name: setup for name, setup in setups.items() if name not in accepted}
    inapplicable = not_applicable(kept, cannot)
    expected = {name: setup for name, setup in kept.items() if name not in inapplicable}
    meant = {
        name: as_meant(setup, profile, accepted) for name, setup in expected.items()
    }
    rows = []
    for name in meant:
        if name in images:
            advance(name)
            rows.append(_result(name, images[name], meant[name]))
    differing = [row for row in rows if not row.conforms]
    causes = list[Cause]()
    unexplained = [row.name for row in differing]
    fitted = [row for row in rows if row.error is not None]
    if differing and fitted:
        advance("looking for causes")
        seen = {row.name: images[row.name].values for row in fitted}
        causes = find_causes(
            {name: image[..., :3] for name, image in seen.items()},
            {name: meant[name] for name in seen},
            {row.name: row.tolerance for row in fitted},
        )
        found = [cause.deviation.key for cause in causes]
        unexplained = [
            row.name
            for row in differing
            if row.error is None
            or not _holds(row, seen[row.name], applied(meant[row.name], found))
        ]
    return Report(
        profile=profile,
        accepted=accepted,
        scenes=tuple(rows),
        causes=tuple(causes),
        unexplained=tuple(unexplained),
        missing=tuple(name for name in expected if name not in images),
        not_applicable=inapplicable,
        nearer=_nearer(profile, rows, images, expected) if differing else None,
    )


def as_meant(setup: Setup, profile: str, accept: Iterable[str] = ()) -> Setup:
    """What makes the reference of a renderer that is meant to have a profile and some
    deviations; other names are passed over.
    """
    keys = [key for key in accept if key in DEVIATIONS]
    return applied(of_profile(setup, profile), keys)


def _result(name: str, image: FoundImage, setup: Setup) -> SceneResult:
    height, width = image.values.shape[:2]
    size = (width, height)
    tolerance = least_tolerance(image.bits)
    if size != (setup.camera.width, setup.camera.height):
        return SceneResult(name, False, None, tolerance, size)
    error = difference(image.values, _reference(setup, image.values))
    if not tolerance.holds(error):
        tolerance = tolerance_of(setup, image.bits)
    return SceneResult(name, tolerance.holds(error), error, tolerance, size)


def _reference(setup: Setup, like: Array, pixels: Pixels | None = None) -> Array:
    """The reference with an alpha where an image has one."""
    colours, alpha = setup.render(pixels)
    return np.dstack([colours, alpha])[..., : like.shape[2]]


def _holds(row: SceneResult, image: Array, setup: Setup) -> bool:
    """Whether some rows and columns of an image are within its tolerance."""
    pixels = sampled(image)
    seen = image[np.ix_(*pixels)]
    return row.tolerance.holds(difference(seen, _reference(setup, image, pixels)))


def _nearer(
    profile: str,
    rows: list[SceneResult],
    images: Mapping[str, FoundImage],
    setups: Mapping[str, Setup],
) -> str | None:
    """Another profile to which more images conform."""
    fitted = [row for row in rows if row.error is not None]
    most = sum(row.conforms for row in fitted)
    found = None
    for other in PROFILES:
        if other == profile:
            continue
        count = sum(
            _holds(row, images[row.name].values, of_profile(setups[row.name], other))
            for row in fitted
        )
        if count > most:
            most = count
            found = other
    return found
