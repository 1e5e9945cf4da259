"""Conditions under which a splat is looked at, by name: renderers, file forms,
distances, image noise, a street.

A new renderer, format or place is a new condition, and no new experiment. The names, of
studies of both attacks:

    ""                               the renderer of the splat's own scene
    "tile", "ray", "volprim", ...    renderers, as `mi-splat compare` calls them
    ".ply", ".spz", ...              the splat goes through a file (`FORMATS`)
    "SH in float16", "SH of degree 1", "median of 8 neighbours"
    "0.5 x distance"                 cameras move towards the object, or away from it
    "5 degrees"                      cameras turn about the object, to the right
    "0.5 x size"                     images with so many times the pixels on each side
    "noise 0.05", "blur 1.5", "JPEG 60", "5 bits"   in the images; pixels, bits
    "09:30"                          a street of meshes in the sun of an hour

and those of other packages (`CONDITIONS`).
"""

import math
import re
import tempfile
import warnings
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from attacks.observe.repairs import median_of_neighbours
from attacks.transformations.draws import ImageTransformation, transform_image
from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.cameras.directions import Point, sun_direction
from mi_splat.comparison.methods import RENDERERS, load_method
from mi_splat.errors import InvalidValueError, nearest
from mi_splat.fields import Checked, at_least, between
from mi_splat.io import SplatLossWarning, load_splat, save_splat
from mi_splat.maths.rotation import to_matrix
from mi_splat.maths.sh import MAX_DEGREE, colour_to_dc
from mi_splat.registry import Registry
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import SAMPLES, MixedScene, resized
from mi_splat.scene import GaussianScene

OWN = "own renderer"
"""What rows call the condition ""."""
_CHANGE = re.compile(
    r"(?P<kind>noise|blur) (?P<size>[0-9]{1,2}(\.[0-9]{1,4})?)|JPEG"
    r" (?P<jpeg>[1-9][0-9]?)"
)
_BITS = re.compile(r"([1-7]) bits")
_TURN = re.compile(r"(-?[0-9]{1,3}(?:\.[0-9]{1,4})?) degrees?")
_SIZE = re.compile(r"([0-9]{1,2}(?:\.[0-9]{1,4})?) x size")
_DISTANCE = re.compile(r"([0-9]{1,3}(?:\.[0-9]{1,4})?) x distance")
_HOUR = re.compile(r"[0-2]\d:[0-5]\d")
Shown = tuple[GaussianScene, RenderFn]
"""What becomes of a splat, and what renders it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SunTable(Checked):
    """A street of meshes under the sun of a day.

    Attributes:
        scene: XML scene of splats among meshes, with the parameters sun_x, sun_y and
            sun_z; north is +y.
        parameter: Of the scene, which names the file of its splat; empty: the scene has
            the object's Gaussians itself.
        north: Cameras farther north, world units, would stand in its houses, and are
            left out; None leaves none out.
        latitude: Of the place, degrees north.
        declination: Of the sun, degrees; 0 at the equinoxes.
        samples: Paths a pixel.
    """

    scene: str
    parameter: str = ""
    north: float | None = None
    latitude: Annotated[float, between(-90, 90, "degrees")] = 45.0
    declination: Annotated[float, between(-90, 90, "degrees")] = 0.0
    samples: Annotated[int, at_least(1, "samples per pixel")] = SAMPLES


@dataclass(frozen=True, slots=True, kw_only=True)
class Viewing:
    """How a splat is looked at as long as no condition changes it."""

    settings: RenderSettings
    centre: Point  # (3,) world units, what cameras move towards
    # the object of a splat without its surroundings
    alone: Callable[[GaussianScene], GaussianScene]
    sun: SunTable | None = None  # the street of conditions that are hours
    # what a street with a splat of its own must hold; None does not ask
    clean: GaussianScene | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """A condition: a renderer after changes to the splat, the camera or the image;
    itself a `RenderFn`.
    """

    name: str  # in the column `condition`
    # what becomes of a splat, and what renders it
    show: Callable[[GaussianScene], Shown]
    move: Callable[[Camera], Camera] = lambda camera: camera  # where a camera stands
    # whether a camera looks at all
    holds: Callable[[Camera], bool] = lambda camera: True

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """The image of a splat under this condition, (H, W, 3) sRGB."""
        shown, render = self.show(scene)
        return render(shown, self.move(camera))


CONDITIONS: Registry[Callable[[Viewing], Condition]] = Registry(
    "mi_splat.conditions",
    "a function of a Viewing that gives a Condition",
    callable,
    what="condition",
)
"""Conditions of other packages, by name."""


def rendered(
    name: str,
    render: RenderFn,
    change: Callable[[GaussianScene], GaussianScene] | None = None,
) -> Condition:
    """A splat in a renderer, after a change (as it is, if None)."""
    return Condition(
        name=name,
        show=lambda scene: (scene if change is None else change(scene), render),
    )


def condition_of(name: str, viewing: Viewing) -> Condition:
    """The condition of a name."""
    check_condition(name, viewing.sun)
    own = renderer_of("", viewing.settings)
    if name in FORMS:
        return rendered(name, own, FORMS[name])
    move = _move_of(name, viewing.centre)
    if move is not None:
        return replace(rendered(name, own), move=move)
    bits = _BITS.fullmatch(name)
    if bits is not None:
        return rendered(name, _with_bits(own, int(bits[1])))
    change = image_transformation(name)
    if change is not None:
        return _changed(name, own, change)
    if viewing.sun is not None and _HOUR.fullmatch(name):
        return _on_street(name, viewing.sun, viewing)
    if name in CONDITIONS and name not in RENDERERS:
        condition = CONDITIONS[name](viewing)
        if not isinstance(condition, Condition):
            what = f"condition {name} of {CONDITIONS.package(name)}"
            got = type(condition).__name__
            raise InvalidValueError.of(
                what,
                "a function that gives a Condition",
                got,
                "return one, or rendered(...)",
            )
        return replace(condition, name=name)
    return rendered(name, renderer_of(name, viewing.settings))


def package_of(name: str) -> str:
    """Which package brings a condition or a renderer, with its version; empty for those
    of this project.
    """
    brought = (
        registry for registry in (RENDERERS, CONDITIONS) if name in registry.brought
    )
    return next((registry.package(name) for registry in brought), "")


def check_condition(name: str, sun: SunTable | None) -> None:
    """Raise unless there is a condition of this name, of which hours need the street;
    nothing is loaded.
    """
    known = (*RENDERERS, *FORMS, *CONDITIONS)
    is_known = (
        name in ("", *known)
        or _move_of(name, (0.0, 0.0, 0.0)) is not None
        or _BITS.fullmatch(name)
        or image_transformation(name) is not None
    )
    if sun is not None and _HOUR.fullmatch(name):
        _sun_at(name, sun)
    elif not is_known:
        do = nearest(
            name,
            known,
            "choose one of them; hours, as 09:30, need [evaluate_with.sun]",
        )
        raise InvalidValueError.of("condition", ", ".join(known), name, do)


def renderer_of(name: str, settings: RenderSettings) -> RenderFn:
    """A renderer by its name, as in `mi-splat compare`; "" is the scene's own."""
    if not name:
        return Renderer(settings)
    if name == "volprim" and any(settings.background):
        black = load_method(name, replace(settings, background=(0.0, 0.0, 0.0))).render
        return _on_background(black, settings.background)
    return load_method(name, settings).render


def _on_background(
    render: RenderFn, background: tuple[float, float, float]
) -> RenderFn:
    """A renderer of black backgrounds with another one: a white copy of the splat shows
    how much it covers.
    """

    def picture(scene: GaussianScene, camera: Camera) -> Tensor:
        white = scene.replace(sh=colour_to_dc(torch.ones_like(scene.means))[:, None])
        covered = render(white, camera)
        return render(scene, camera) + (1 - covered) * torch.tensor(background).to(
            covered
        )

    return picture


def _move_of(name: str, centre: Point) -> Callable[[Camera], Camera] | None:
    """Where a condition puts a camera, or which size it gives its images; None for one
    that does neither.
    """
    distance = _DISTANCE.fullmatch(name)
    if distance is not None:
        return partial(_moved, factor=float(distance[1]), centre=centre)
    turn = _TURN.fullmatch(name)
    if turn is not None:
        return partial(_turned, degrees=float(turn[1]), centre=centre)
    size = _SIZE.fullmatch(name)
    if size is not None and float(size[1]) > 0:
        return partial(_scaled, factor=float(size[1]))
    return None


def _turned(camera: Camera, *, degrees: float, centre: Point) -> Camera:
    """The camera turned about a point, around the axis that is vertical in its
    image.
    """
    half = math.radians(degrees) / 2
    down = camera.to_world[:3, 1].double()
    quaternion = torch.cat([down.new_tensor([math.cos(half)]), -math.sin(half) * down])
    pivot = torch.tensor(centre, dtype=torch.float64)
    return camera.turned(to_matrix(quaternion), pivot)


def _scaled(camera: Camera, *, factor: float) -> Camera:
    """The camera with other numbers of pixels."""
    return resized(
        camera, (round(camera.width * factor), round(camera.height * factor))
    )


def _with_bits(render: RenderFn, bits: int) -> RenderFn:
    """A renderer whose images have so many bits for each colour channel."""
    steps = 2**bits - 1

    def picture(scene: GaussianScene, camera: Camera) -> Tensor:
        image = render(scene, camera).clamp(0, 1)
        return image.mul(steps).round().div(steps)

    return picture


def _moved(camera: Camera, *, factor: float, centre: Point) -> Camera:
    """The camera moved along the line to the centre, looking the same way."""
    pivot = torch.tensor(centre).to(camera.to_world)
    pose = camera.to_world.clone()
    pose[:3, 3] = pivot + factor * (pose[:3, 3] - pivot)
    return replace(camera, to_world=pose)


def image_transformation(name: str) -> ImageTransformation | None:
    """What happens to an image that is called "noise 0.05", "blur 1.5" (pixels) or
    "JPEG 60"; None for other names.
    """
    called = _CHANGE.fullmatch(name)
    if called is None:
        return None
    if called["jpeg"] is not None:
        return ImageTransformation(jpeg=int(called["jpeg"]))
    size = float(called["size"])
    if called["kind"] == "noise":
        return ImageTransformation(noise=size)
    return ImageTransformation(blur=size)


def _changed(name: str, render: RenderFn, change: ImageTransformation) -> Condition:
    """Images with noise, blur or JPEG in them; noise is another one for each
    camera.
    """

    def picture(scene: GaussianScene, camera: Camera) -> Tensor:
        seed = change.noise_seed + zlib.crc32(camera.to_world.numpy().tobytes())
        return transform_image(render(scene, camera), replace(change, noise_seed=seed))

    return rendered(name, picture)


FORMATS = (".ply", ".compressed.ply", ".spz", ".sog", ".glb", ".splat")
"""Formats that a splat can go through."""


def through_file(scene: GaussianScene, suffix: str) -> GaussianScene:
    """The splat after it was saved in a format and loaded again."""
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


FORMS: Mapping[str, Callable[[GaussianScene], GaussianScene]] = {
    **{suffix: partial(through_file, suffix=suffix) for suffix in FORMATS},
    "SH in float16": half_precision,
    **{
        f"SH of degree {degree}": partial(fewer_bands, degree=degree)
        for degree in range(MAX_DEGREE + 1)
    },
    **{
        f"median of {count} neighbours": partial(median_of_neighbours, count=count)
        for count in (4, 8, 16)
    },
}
"""What becomes of a splat in other formats, with SH in half precision, with fewer SH
bands, and smoothed by a defender.
"""


def _sun_at(hour: str, sun: SunTable) -> tuple[float, float, float]:
    """(3,) where the sun is at an hour as 09:30, of local solar time."""
    hours, minutes = hour.split(":")
    return sun_direction(
        int(hours) + int(minutes) / 60,
        latitude=sun.latitude,
        declination=sun.declination,
    )


def _on_street(name: str, sun: SunTable, viewing: Viewing) -> Condition:
    """The object alone, on a street of meshes."""
    east, north, up = _sun_at(name, sun)
    street_with = partial(
        MixedScene,
        Path(sun.scene),
        samples=sun.samples,
        sun_x=east,
        sun_y=north,
        sun_z=up,
    )
    fixed = None if sun.parameter else street_with()
    alone = viewing.alone
    clean = viewing.clean
    if fixed is not None and clean is not None:
        inside = fixed.splats.scene
        if len(inside) != len(clean) or not torch.equal(inside.means, clean.means):
            expected = "the Gaussians of the object and no others"
            do = "name the file of that object in the scene"
            raise InvalidValueError.of(
                sun.scene, expected, f"{len(inside):,} others", do
            )

    def show(scene: GaussianScene) -> Shown:
        if fixed is not None:
            return alone(scene), fixed
        with tempfile.TemporaryDirectory() as folder:
            path = (Path(folder) / "splat.ply").resolve()
            save_splat(alone(scene), path)
            street = street_with(**{sun.parameter: str(path)})  # type: ignore[arg-type]
        return street.splats.scene, street

    def holds(camera: Camera) -> bool:
        return sun.north is None or float(camera.position[1]) < sun.north

    return Condition(name=name, show=show, holds=holds)
