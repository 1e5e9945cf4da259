"""The cards of scenes, cameras, sets of pictures, trained splats, comparisons and audits; see `mi_splat.cards`.

A card is drawn when a notebook shows a value, so it is quick and never fails: a splat is rendered small, and where that
does not work its facts are shown alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import singledispatch
from itertools import islice

import torch

from mi_splat.audit.results import Audit
from mi_splat.bounds import near_plane
from mi_splat.camera_sets import CameraList
from mi_splat.cameras import Camera, View, ViewSet, cameras_of
from mi_splat.cards import HEIGHT, card, picture, sky
from mi_splat.comparison.compare import Comparison
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import SplatScene, orbit_camera, resized
from mi_splat.training.loop import Fit
from mi_splat.variant import device_of, variant_kept

MOST = 1_000_000
"""Gaussians that are drawn at most: those that cover most."""
_SIZE, _AZIMUTH, _ELEVATION = (192, HEIGHT), -60.0, 20.0
"""Pixels of a picture of a splat, and degrees from where it is taken."""
_BACKGROUND = (0.93, 0.93, 0.93)
_PICTURES = 4
"""Pictures in a row at most."""


@singledispatch
def html(value: object) -> str:
    """The card of a value, as HTML."""
    return card(repr(value))


def drawn(value: object, draw: Callable[[], Sequence[str]]) -> str:
    """A card with drawings, or without them where drawing fails."""
    try:
        drawings = draw()
    except Exception as error:  # noqa: BLE001 - whatever is wrong with a value, a notebook has to be able to show it
        return card(f"{value!r} (no picture: {type(error).__name__})")
    return card(repr(value), *drawings)


@html.register
def _scene(value: GaussianScene) -> str:
    return drawn(value, lambda: [_rendered(value)])


@html.register
def _splat_scene(value: SplatScene) -> str:
    def draw() -> list[str]:
        if not value.cameras:
            return [_rendered(value.scene)]
        return [
            _rendered(value.scene, camera, value.settings, name)
            for name, camera in islice(value.cameras.items(), _PICTURES)
        ]

    return drawn(value, draw)


@html.register
def _camera(value: Camera) -> str:
    return drawn(value, lambda: [_directions([value])])


@html.register
def _cameras(value: CameraList) -> str:
    return drawn(value, lambda: [_directions(value)])


@html.register
def _view(value: View) -> str:
    return drawn(value, lambda: [picture(value.image)])


@html.register
def _views(value: ViewSet) -> str:
    def draw() -> list[str]:
        count = min(_PICTURES, len(value))
        numbers = [number * len(value) // count for number in range(count)]
        pictures = [picture(value[number].image, f"view {number}") for number in numbers]
        return [*pictures, _directions(cameras_of(value))]

    return drawn(value, draw)


@html.register
def _fit(value: Fit) -> str:
    return drawn(value, lambda: [_rendered(value.scene)])


@html.register
def _comparison(value: Comparison) -> str:
    seen = next(iter(value.pictures.values()), {})
    return drawn(value, lambda: [picture(image, name) for name, image in islice(seen.items(), _PICTURES)])


@html.register
def _audit(value: Audit) -> str:
    def draw() -> list[str]:
        item = value.strongest
        if item.verdict == "nothing found":
            return [sky(item.directions.numpy(), [False] * len(item.directions), "no direction shows anything else")]
        return [sky(item.directions.numpy(), item.look.shown.tolist(), "filled: what it shows from there is hidden")]

    return drawn(value, draw)


def _directions(cameras: Sequence[Camera]) -> str:
    """Where cameras stand, as seen from what they look at."""
    backwards = -torch.stack([camera.to_world[:3, 2] for camera in cameras])
    return sky(backwards.numpy(), [True] * len(cameras), "from where, seen from above; inner ring: the horizon")


def _rendered(
    scene: GaussianScene, camera: Camera | None = None, settings: RenderSettings | None = None, caption: str = ""
) -> str:
    """A small picture of a splat, from a camera or from where all of it shows."""
    scene = largest(scene.detach(), MOST)
    if camera is None:
        camera = orbit_camera(scene, azimuth=_AZIMUTH, elevation=_ELEVATION, distance=None, fov=45, size=_SIZE)
    else:
        factor = min(1.0, HEIGHT / camera.height)
        camera = resized(camera, (max(1, round(camera.width * factor)), max(1, round(camera.height * factor))))
    with torch.no_grad(), variant_kept():
        render = Renderer(settings or RenderSettings(background=_BACKGROUND, near=near_plane(scene, [camera])))
        return picture(render(scene.to(device_of(render.variant)), camera), caption)


def largest(scene: GaussianScene, most: int) -> GaussianScene:
    """The Gaussians that cover most, so that a picture of a large splat is quick."""
    if len(scene) <= most:
        return scene
    area = scene.scales.sort(dim=1).values[:, 1:].prod(1) * scene.opacities
    return scene.select(area.topk(most).indices)
