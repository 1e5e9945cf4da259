"""The object and the cameras that a command's options describe, a name for each camera,
and how images are made.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, odd_fields_of_view, orbit_pose
from mi_splat.cameras.directions import UP
from mi_splat.cameras.forms import FORMS
from mi_splat.cameras.framing import bounds, culled_in_view, near_plane, nothing_in_view
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.rooms import AROUND, place_inside
from mi_splat.cameras.sets import camera_set, framing, with_up
from mi_splat.cli.console import note, warn
from mi_splat.cli.options import CameraOptions, axis_name, up_line
from mi_splat.cli.sources import FindBoxes, Found, find_in_images, source_images
from mi_splat.datasets import DatasetError, load_dataset
from mi_splat.datasets.colmap import find_model
from mi_splat.datasets.frames import Split
from mi_splat.datasets.poses import numbered, poses_of
from mi_splat.datasets.transforms import find_transforms
from mi_splat.errors import InvalidValueError, MiSplatError, nearest
from mi_splat.io.camera_records import OF, recorded_cameras, unique_names
from mi_splat.io.up_axis import Direction, UpAxis, Z, cameras_up
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import SplatScene, open_scene, resized
from mi_splat.scene import GaussianScene
from mi_splat.selection.agreement import Agreement, agreement, disagreements
from mi_splat.selection.config import Selection
from mi_splat.selection.select import doubts, select
from mi_splat.selection.visibility import object_weight

ALL = "all"
"""Names all cameras of a scene."""
SIZE = (640, 480)
_FILES = (".json", ".xml")
"""Endings of files with cameras."""
_WORTH_A_WORD = 0.01
"""A share of the Gaussians that the near plane hides before it is said."""
AZIMUTH = 30.0
ELEVATION = 20.0
_TRIED = (
    (30.0, 20.0),
    (120.0, 20.0),
    (210.0, 20.0),
    (300.0, 20.0),
    (30.0, 60.0),
    (30.0, -20.0),
)
"""Azimuth and elevation of the cameras of which the first is taken that shows the
object well.
"""
_GOOD = 0.6
"""Share of the best one's part of the image from which on a camera shows the object
well.
"""

_COMPARED = 5
_FEWEST_COMPARED = 3
"""Images of a set that are compared with renderings."""
_LONGEST_SIDE = 128
_THUMBNAIL = 16
"""Pixels of these renderings, and of what is compared of them."""
_ALIKE = 0.9
_GAINED = 0.25
"""A correlation from which on an image is like its rendering; share of what lacks to 1
that else has to be gained.
"""

Shows = Callable[[Camera], float]
"""How much of its image an object makes up, seen from a camera."""


def find_cameras(
    loaded: SplatScene,
    options: CameraOptions,
    *,
    focus: GaussianScene | None = None,
    shows: Shows | None = None,
    split: Split | None = None,
) -> dict[str, Camera]:
    """The cameras by name, in the order in which they are asked for; warns of odd
    fields of view and other worlds.
    """
    if options.up is not None or not _are_placed(loaded, options):
        options = upright(loaded, options)
    cameras = _cameras(loaded, options, focus, shows, split)
    odd = odd_fields_of_view(list(cameras.values()))
    if odd is not None:
        warn(odd)
    _warn_of_other_worlds(loaded, options)
    return cameras


def _warn_of_other_worlds(loaded: SplatScene, options: CameraOptions) -> None:
    """Warn of sets whose photographs do not look like the splat."""
    for text in options.cameras:
        folder = Path(text)
        if not folder.is_dir():
            continue
        strange = another_world(loaded, options, folder)
        if strange is not None:
            warn(strange)


def _are_placed(loaded: SplatScene, options: CameraOptions) -> bool:
    """Whether the cameras have their places already, and need no direction that is
    up.
    """
    if options.cameras:
        return not any(_is_set(text, loaded) for text in options.cameras)
    return bool(loaded.cameras) and not options.orbits


def upright(
    loaded: SplatScene, options: CameraOptions, cameras: Iterable[Camera] = ()
) -> CameraOptions:
    """The options with the direction that is up; one line says which is taken, and how
    to turn it.

    Cameras that have their places tell more than a ground.
    """
    if options.up is not None:
        if options.up != UP:
            warn(f"up is {axis_name(options.up)}")
        return options
    if loaded.up is None:  # a scene of this library
        return dataclasses.replace(options, up=Z)
    up = loaded.up
    if not up.is_stated:
        poses = [camera.to_world[:3, :3].double().cpu().numpy() for camera in cameras]
        stood = cameras_up(np.array(poses)) if len(poses) > 1 else None
        up = up if stood is None else UpAxis(stood, "as the cameras stand")
    note(up_line(up))
    return dataclasses.replace(options, up=up.direction)


def _cameras(
    loaded: SplatScene,
    options: CameraOptions,
    focus: GaussianScene | None,
    shows: Shows | None,
    split: Split | None,
) -> dict[str, Camera]:
    """The cameras, where the options say which way is up, if that is needed."""
    target = loaded.scene if focus is None else focus
    if options.cameras:
        _check_meaning(loaded, options)
        return _unique(
            pair
            for text in options.cameras
            for pair in _meant(text, loaded, options, target, split)
        )
    if loaded.cameras and not options.orbits:
        name, camera = next(iter(loaded.cameras.items()))
        return {name: _sized(camera, options)}
    if shows is not None and options.azimuth is None and options.elevation is None:
        tried = [
            _orbit(target, options, azimuth, elevation) for azimuth, elevation in _TRIED
        ]
        shares = [shows(camera) for camera in tried]
        good = (
            camera
            for camera, share in zip(tried, shares, strict=True)
            if share >= _GOOD * max(shares)
        )
        return {"orbit": next(good)}
    azimuth = AZIMUTH if options.azimuth is None else options.azimuth
    elevation = ELEVATION if options.elevation is None else options.elevation
    if focus is None and options.centre is None and options.distance is None:
        options, azimuth = _inside(target, options, azimuth, elevation)
    return {"orbit": _orbit(target, options, azimuth, elevation)}


def _inside(
    target: GaussianScene, options: CameraOptions, azimuth: float, elevation: float
) -> tuple[CameraOptions, float]:
    """The options with a place inside, if the scene is a room; and the azimuth, the
    best of four if none is given.
    """
    azimuths = AROUND if options.azimuth is None else [azimuth]
    place = place_inside(target, azimuths, elevation=elevation, up=options.up or Z)
    if place is None:
        return options, azimuth
    if not place.is_room:
        do = f"pass --distance {place.distance:.2g} to look from inside"
        warn(f"the scene is hollow; if it is an empty room, {do}")
        return options, azimuth
    return (
        dataclasses.replace(options, centre=place.centre, distance=place.distance),
        place.azimuth,
    )


def render_settings(
    loaded: SplatScene, options: CameraOptions, cameras: dict[str, Camera]
) -> RenderSettings:
    """How the images are made: the scene's settings, but for what the options say."""
    settings = loaded.settings
    if options.near is not None:
        settings = dataclasses.replace(settings, near=options.near)
    elif not loaded.cameras:
        settings = dataclasses.replace(
            settings, near=near_plane(loaded.scene, tuple(cameras.values()))
        )
    if options.background is not None:
        settings = dataclasses.replace(settings, background=options.background)
    return settings


def _check_meaning(loaded: SplatScene, options: CameraOptions) -> None:
    """Raise if a flag would mean nothing beside --cameras."""
    placed = not any(_is_set(text, loaded) for text in options.cameras)
    given: dict[str, object] = {
        "--azimuth": options.azimuth,
        "--elevation": options.elevation,
    }
    given |= {"--camera-roll": options.camera_roll or None}
    given |= (
        {"--distance": options.distance, "--centre": options.centre} if placed else {}
    )
    idle = [flag for flag, value in given.items() if value is not None]
    if idle:
        got = f"--cameras {' '.join(options.cameras)} and {', '.join(idle)}"
        if placed:
            what = "cameras that have their places"
        else:
            what = "either a set of cameras or one on an orbit"
        raise InvalidValueError.of("cameras", what, got, "leave one out")


def _is_set(text: str, loaded: SplatScene) -> bool:
    """Whether a text means cameras around a centre, and not some that have their
    places.
    """
    file = Path(
        text if OF not in text or Path(text).exists() else text.rpartition(OF)[0]
    )
    return (
        ":" in text
        and text not in loaded.cameras
        and not (file.suffix.lower() in _FILES or file.is_dir())
    )


def renderer_of(
    loaded: SplatScene, options: CameraOptions, cameras: dict[str, Camera]
) -> Renderer:
    """The renderer of `render_settings`; warns of cameras that see no Gaussian, or
    whose near plane hides many.
    """
    settings = render_settings(loaded, options, cameras)
    unseen = nothing_in_view(loaded.scene, list(cameras.values()))
    if unseen:
        warn(unseen)
    counts = {
        name: culled_in_view(loaded.scene, camera, settings.near)
        for name, camera in cameras.items()
    }
    worst = max(counts, key=lambda name: counts[name], default="")
    if counts and counts[worst] > _WORTH_A_WORD * len(loaded.scene):
        many = (
            f"{counts[worst]:,} Gaussians are nearer than {settings.near:g} and not"
            " drawn"
        )
        warn(f"camera {worst}: {many}; --near changes that")
    return Renderer(settings)


def _unique(named: Iterable[tuple[str, Camera]]) -> dict[str, Camera]:
    pairs = list(named)
    return dict(
        zip(
            unique_names(name for name, _ in pairs),
            (camera for _, camera in pairs),
            strict=True,
        )
    )


def _meant(
    text: str,
    loaded: SplatScene,
    options: CameraOptions,
    target: GaussianScene,
    split: Split | None,
) -> list[tuple[str, Camera]]:
    """The cameras that one text means, which may be one of a file or a folder."""
    source, mark, wanted = text.rpartition(OF)
    if (
        not mark
        or text in loaded.cameras
        or Path(text).exists()
        or not Path(source).exists()
    ):
        return _named(text, loaded, options, target, split)
    # whoever names one means it
    cameras = _unique(_named(source, loaded, options, target, None))
    if wanted not in cameras:
        do = nearest(wanted, cameras, "name one that is there")
        raise InvalidValueError.of(
            source, f"a camera {wanted}", f"{len(cameras)} others", do
        )
    return [(wanted, cameras[wanted])]


def _named(
    text: str,
    loaded: SplatScene,
    options: CameraOptions,
    target: GaussianScene,
    split: Split | None,
) -> list[tuple[str, Camera]]:
    """The cameras that one text means, with names that may not differ."""
    path = Path(text)
    if text in loaded.cameras:
        named = [(text, loaded.cameras[text])]
    elif text == ALL and loaded.cameras:
        named = list(loaded.cameras.items())
    elif text == ALL:
        warn(
            "the scene has no cameras of its own; all means the usual camera on an"
            " orbit"
        )
        return [("orbit", _orbit(target, options, AZIMUTH, ELEVATION))]
    elif path.suffix.lower() == ".json":
        named = _listed(path, options)
    elif path.suffix.lower() == ".xml":
        named = list(open_scene(path).cameras.items())
    elif path.is_dir():
        named = _beside_pictures(path, options, split)
    elif _is_set(text, loaded):
        centre, distance, lens = _placement(target, options)
        cameras = camera_set(text, centre, distance=distance, lens=lens)
        turned = [with_up(camera, centre, options.up or Z) for camera in cameras]
        return list(numbered(text.partition(":")[0], turned).items())
    else:
        if loaded.cameras:
            names = f"one of {', '.join(loaded.cameras)}"
        else:
            names = "no name, since the scene has no cameras"
        raise InvalidValueError.of(
            "camera",
            f"{names}; or {FORMS}, or a folder",
            text,
            "name one that is there",
        )
    return [(name, _sized(camera, options)) for name, camera in named]


def another_world(
    loaded: SplatScene, options: CameraOptions, folder: Path
) -> str | None:
    """What to warn of where the images of a set do not look like renderings from their
    own cameras; else None.

    A set of another scene, or one whose world was turned or scaled since, shows other
    things from its cameras. Each of some images is compared with the renderings from
    all of their cameras: the own one has to be most alike.
    """
    try:
        views = load_dataset(
            folder,
            split=None,
            background=options.background or loaded.settings.background,
        )
    except MiSplatError:  # poses alone
        return None
    count = min(len(views), _COMPARED)
    if count < _FEWEST_COMPARED:
        return None
    chosen = [round(i * (len(views) - 1) / (count - 1)) for i in range(count)]
    longest = max(max(camera.width, camera.height) for camera in views.cameras)
    small = dataclasses.replace(views, downscale=max(1, longest // _LONGEST_SIDE))
    cameras = {str(i): small.cameras[i] for i in chosen}
    render = Renderer(render_settings(loaded, options, cameras))
    with torch.no_grad():
        drawn = torch.stack(
            [_thumbnail(render(loaded.scene, camera)) for camera in cameras.values()]
        )
    taken = torch.stack([_thumbnail(small[i].image) for i in chosen])
    alike = taken @ drawn.T  # correlations: images by rows, cameras by columns
    own = float(alike.diagonal().mean())
    others = (float(alike.sum()) - own * count) / (count * (count - 1))
    # Of one object on a plain background all images are alike, so what counts is how
    # much of the rest is gained.
    gained = (own - others) / max(1 - others, 1e-6)
    if own > _ALIKE or gained > _GAINED:
        return None
    return (
        f"{folder}: its images do not look like the splat from their own cameras"
        f" (correlation {own:.2f}, {others:.2f} from each other's); do the cameras"
        " belong to another scene, or was the splat turned or scaled since?"
    )


def _thumbnail(image: Tensor) -> Tensor:
    """A small grey image as a vector of mean 0 and length 1, or zeros where it has one
    colour.
    """
    grey = image[..., :3].clamp(0, 1).mean(-1)[None, None]
    values = torch.nn.functional.adaptive_avg_pool2d(grey, _THUMBNAIL).flatten()
    values = values - values.mean()
    length = float(values.norm())
    if length > 1e-4:
        return values / length
    return torch.zeros_like(values)


def _listed(path: Path, options: CameraOptions) -> list[tuple[str, Camera]]:
    recorded = recorded_cameras(path)
    if recorded is not None:
        return list(recorded.items())
    return list(poses_of(path, options.size or SIZE).items())


def _beside_pictures(
    folder: Path, options: CameraOptions, split: Split | None
) -> list[tuple[str, Camera]]:
    """The cameras of a set of images by their names; where images or lenses cannot be
    read, the poses alone.
    """
    is_model = find_model(folder) is not None and find_transforms(folder) is None
    if is_model:  # whose poses are all meant, also those of images that are missing
        return list(poses_of(folder, options.size or SIZE, split).items())
    try:
        pictures = load_dataset(folder, split=split)
    except DatasetError:
        if find_transforms(folder) is None:
            raise
        return list(poses_of(folder, options.size or SIZE).items())
    return [
        (file.stem, camera)
        for file, camera in zip(pictures.paths, pictures.cameras, strict=True)
    ]


def _sized(camera: Camera, options: CameraOptions) -> Camera:
    if options.size is None:
        return camera
    return resized(camera, options.size)


def _placement(
    target: GaussianScene, options: CameraOptions
) -> tuple[tuple[float, float, float], float, Lens]:
    """Where cameras look, how far away they are, and their lens."""
    middle, radius = bounds(target)
    distance, lens = framing(radius, fov=options.fov, size=options.size or SIZE)
    centre = middle if options.centre is None else options.centre
    return centre, distance if options.distance is None else options.distance, lens


def _orbit(
    target: GaussianScene, options: CameraOptions, azimuth: float, elevation: float
) -> Camera:
    centre, distance, lens = _placement(target, options)
    pose = orbit_pose(
        centre,
        azimuth=azimuth,
        elevation=elevation,
        distance=distance,
        roll=options.camera_roll,
    )
    return with_up(Camera(to_world=pose, lens=lens), centre, options.up or Z)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chosen:
    """An object, and where it is looked at from."""

    mask: Tensor
    cameras: dict[str, Camera]
    render: Renderer
    up: Direction
    found: Found | None = None  # what images say of it, if they were asked

    def weights(self, loaded: SplatScene) -> dict[str, Tensor]:
        """(H, W) share of each pixel that the object makes up, by the camera's name."""
        return {
            name: object_weight(loaded.scene, self.mask, camera, self.render)
            for name, camera in self.cameras.items()
        }

    def agreement(self, loaded: SplatScene) -> dict[str, Agreement]:
        """How well the object agrees with its outlines in images; empty if none were
        asked.
        """
        if self.found is None:
            return {}
        regions = self.found.regions
        return agreement(loaded.scene, self.mask, regions, render=self.render)

    def doubts(
        self, weights: Mapping[str, Tensor], agreed: Mapping[str, Agreement]
    ) -> list[str]:
        """Reasons to look twice at the object, in words."""
        found = () if self.found is None else self.found.doubts
        return [*doubts(self.mask, weights), *found, *disagreements(agreed)]


def choose(
    loaded: SplatScene,
    selection: Selection,
    options: CameraOptions,
    *,
    split: Split | None = None,
    find_boxes: FindBoxes | None = None,
) -> Chosen:
    """The object and the cameras.

    A click is on the image that `mi-splat render` makes with the same flags, so with
    one the cameras come first, and with images that show where the object is, too.
    Otherwise the object does, and cameras that nothing else is said of look at it.
    """
    if not selection.click and not selection.needs_images:
        mask = select(loaded.scene, selection, objects=loaded.objects)
        return look_at_object(loaded, mask, options, split=split)
    options, cameras = _upright_cameras(loaded, options, None, None, split)
    render = renderer_of(loaded, options, cameras)
    found = None
    if selection.needs_images:
        _warn_of_other_worlds(loaded, options)
        images = source_images(
            loaded.scene, cameras, options.cameras, render=render, split=split
        )
        found = find_in_images(
            loaded.scene, images, selection, render=render, find_boxes=find_boxes
        )
    mask = select(
        loaded.scene,
        selection,
        objects=loaded.objects,
        camera=next(iter(cameras.values())),
        render=render,
        found=None if found is None else found.mask,
    )
    up = options.up or Z
    return Chosen(mask=mask, cameras=cameras, render=render, up=up, found=found)


def look_at_object(
    loaded: SplatScene,
    mask: Tensor,
    options: CameraOptions,
    *,
    split: Split | None = None,
) -> Chosen:
    """An object that is known, and the cameras."""

    def shows(camera: Camera) -> float:
        small = Renderer(render_settings(loaded, options, {"": camera}))
        with torch.no_grad():
            return float(object_weight(loaded.scene, mask, camera, small).mean())

    options, cameras = _upright_cameras(
        loaded, options, loaded.scene.select(mask), shows, split
    )
    render = renderer_of(loaded, options, cameras)
    return Chosen(mask=mask, cameras=cameras, render=render, up=options.up or Z)


def _upright_cameras(
    loaded: SplatScene,
    options: CameraOptions,
    focus: GaussianScene | None,
    shows: Shows | None,
    split: Split | None,
) -> tuple[CameraOptions, dict[str, Camera]]:
    """The options with the direction that is up, and the cameras: first what the other
    one needs.
    """
    if _are_placed(loaded, options):
        cameras = _cameras(loaded, options, focus, shows, split)
        return upright(loaded, options, cameras.values()), cameras
    options = upright(loaded, options)
    return options, _cameras(loaded, options, focus, shows, split)
