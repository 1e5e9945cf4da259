"""Conditions under which a splat is looked at: renderers, file forms, distances, picture noise, a street in the sun.

A new renderer, format or place is a new condition, and no new experiment.
"""

from __future__ import annotations

import re
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from attacks.transformations.draws import PictureChange, change_picture
from mi_splat.cameras import Camera, RenderFn
from mi_splat.comparison.colour_clamps import cut_to_bytes, not_cut
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import at_least, between, check
from mi_splat.io import SplatLossWarning, load_splat, save_splat
from mi_splat.mixed_scenes import SAMPLES, MixedScene
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc
from mi_splat.sun import clock, sun_direction

_CHANGE = re.compile(r"(?P<kind>noise|blur) (?P<size>[0-9]{1,2}(\.[0-9]{1,4})?)|JPEG (?P<jpeg>[1-9][0-9]?)")
Shown = tuple[GaussianScene, RenderFn]
"""What becomes of a splat, and what renders it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """One way to look at a splat, itself a `RenderFn`.

    Attributes:
        name: In the column `condition`.
        show: What becomes of a splat, and what renders it.
        move: Where a camera stands.
    """

    name: str
    show: Callable[[GaussianScene], Shown]
    move: Callable[[Camera], Camera] = lambda camera: camera

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """The picture of a splat under this condition, (H, W, 3) sRGB."""
        shown, render = self.show(scene)
        return render(shown, self.move(camera))


def rendered(name: str, render: RenderFn, change: Callable[[GaussianScene], GaussianScene] | None = None) -> Condition:
    """A splat in a renderer, after a change (as it is, if None)."""
    return Condition(name=name, show=lambda scene: (scene if change is None else change(scene), render))


def on_background(render: RenderFn, background: tuple[float, float, float]) -> RenderFn:
    """A renderer of black backgrounds with another one: a white copy of the splat shows how much it covers."""

    def picture(scene: GaussianScene, camera: Camera) -> Tensor:
        white = scene.replace(sh=colour_to_dc(torch.ones_like(scene.means))[:, None])
        covered = render(white, camera)
        return render(scene, camera) + (1 - covered) * torch.tensor(background).to(covered)

    return picture


def file_forms(
    render: RenderFn, *, files: Iterable[str] = (), float16: bool = False, sh_degrees: Iterable[int] = ()
) -> list[Condition]:
    """The splat after other formats, with SH in half precision, and with fewer SH bands.

    Args:
        render: The renderer.
        files: Of `FORMATS`.
        float16: Whether its SH is rounded to half precision.
        sh_degrees: Degrees that its SH is cut to.
    """
    return [
        *(rendered(suffix, render, partial(through_file, suffix=suffix)) for suffix in files),
        *([rendered("SH in float16", render, half_precision)] if float16 else []),
        *(rendered(f"SH of degree {degree}", render, partial(fewer_bands, degree=degree)) for degree in sh_degrees),
    ]


def colour_clamps(render: RenderFn) -> list[Condition]:
    """Renderers that cut colours elsewhere than 3D Gaussian Splatting does."""
    return [
        rendered("colours cut to [0, 1]", cut_to_bytes(render)),
        rendered("colours not cut", not_cut(render)),
    ]


def distances(render: RenderFn, factors: Iterable[float], centre: Point) -> list[Condition]:
    """Cameras moved towards a centre (3,), world units, or away from it, looking the same way.

    Args:
        render: The renderer.
        factors: Distances in units of the cameras' own.
        centre: What they move towards.
    """
    return [
        replace(rendered(f"{factor:g} x distance", render), move=partial(_moved, factor=factor, centre=centre))
        for factor in factors
    ]


def _moved(camera: Camera, *, factor: float, centre: Point) -> Camera:
    pivot = torch.tensor(centre).to(camera.to_world)
    pose = camera.to_world.clone()
    pose[:3, 3] = pivot + factor * (pose[:3, 3] - pivot)
    return replace(camera, to_world=pose)


def picture_change(name: str) -> PictureChange | None:
    """What happens to a picture that is called "noise 0.05", "blur 1.5" (pixels) or "JPEG 60"; None for other names."""
    called = _CHANGE.fullmatch(name)
    if called is None:
        return None
    if called["jpeg"] is not None:
        return PictureChange(jpeg=int(called["jpeg"]))
    size = float(called["size"])
    return PictureChange(noise=size) if called["kind"] == "noise" else PictureChange(blur=size)


def changed(name: str, render: RenderFn, change: PictureChange) -> Condition:
    """Pictures with noise, blur or JPEG in them; noise is another one for each camera."""

    def picture(scene: GaussianScene, camera: Camera) -> Tensor:
        seed = change.noise_seed + zlib.crc32(camera.to_world.numpy().tobytes())
        return change_picture(render(scene, camera), replace(change, noise_seed=seed))

    return rendered(name, picture)


FORMATS = (".ply", ".compressed.ply", ".spz", ".sog", ".glb", ".splat")
"""Formats that a splat can go through."""


def through_file(scene: GaussianScene, suffix: str) -> GaussianScene:
    """The splat after it was saved in a format and loaded again.

    Args:
        scene: The splat.
        suffix: One of `FORMATS`.

    Raises:
        InvalidValueError: It is none of them.
    """
    if suffix not in FORMATS:
        raise InvalidValueError(message("format", f"one of {', '.join(FORMATS)}", suffix, "choose one"))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", SplatLossWarning)
        path = Path(folder) / f"splat{suffix}"
        save_splat(scene, path)
        return load_splat(path)


def half_precision(scene: GaussianScene) -> GaussianScene:
    """The splat with SH rounded to float16."""
    return scene.replace(sh=scene.sh.half().to(scene.sh))


def fewer_bands(scene: GaussianScene, degree: int) -> GaussianScene:
    """The splat with SH of at most this degree."""
    return scene.with_degree(min(degree, scene.degree))


@dataclass(frozen=True, slots=True, kw_only=True)
class SunTable:
    """A street of meshes at several hours of a day.

    Attributes:
        scene: XML scene of splats among meshes, with the parameters sun_x, sun_y and sun_z; north is +y.
        hours: Local solar time, 12 is noon.
        latitude: Of the place, degrees north.
        declination: Of the sun, degrees; 0 at the equinoxes.
        samples: Paths a pixel.

    Raises:
        InvalidValueError: There are no hours, two show the same minute, the sun is not up at one of them, or a number
            is out of its range.
    """

    scene: str
    hours: tuple[float, ...]
    latitude: Annotated[float, between(-90, 90, "degrees")] = 45.0
    declination: Annotated[float, between(-90, 90, "degrees")] = 0.0
    samples: Annotated[int, at_least(1, "samples per pixel")] = SAMPLES

    def __post_init__(self) -> None:
        check(self)
        if not self.hours:
            raise InvalidValueError(message("hours", "at least one", "none", "name some, for instance [9.0, 12.0]"))
        for hour in self.hours:
            sun_direction(hour, latitude=self.latitude, declination=self.declination)
        shown = [clock(hour) for hour in self.hours]
        if len(set(shown)) < len(shown):
            raise InvalidValueError(message("hours", "different minutes", ", ".join(shown), "leave the second out"))


def street_at(sun: SunTable, hour: float, **parameters: Any) -> MixedScene:
    """The street at one hour.

    Args:
        sun: The street.
        hour: Local solar time.
        parameters: Others of the scene file, for instance `car="a.ply"`.

    Raises:
        InvalidValueError: The sun is not up.
        MiSplatError: The file cannot be read, or is no scene of splats among surfaces.
    """
    east, north, up = sun_direction(hour, latitude=sun.latitude, declination=sun.declination)
    return MixedScene(Path(sun.scene), samples=sun.samples, sun_x=east, sun_y=north, sun_z=up, **parameters)


def street_hours(
    sun: SunTable, cut_out: Callable[[GaussianScene], GaussianScene], *, parameter: str
) -> Iterator[Condition]:
    """A street of meshes with another splat in the place of its own, by the hour.

    Args:
        sun: The street.
        cut_out: The object alone, of a splat.
        parameter: Of the scene file, which names the file of the splat: for instance "car".
    """

    def show(scene: GaussianScene, hour: float) -> Shown:
        with tempfile.TemporaryDirectory() as folder:
            path = (Path(folder) / "splat.ply").resolve()
            save_splat(cut_out(scene), path)
            street = street_at(sun, hour, **{parameter: str(path)})
        return street.splats.scene, street

    for hour in sun.hours:
        yield Condition(name=clock(hour), show=partial(show, hour=hour))
