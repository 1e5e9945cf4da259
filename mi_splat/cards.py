"""What a notebook shows of a value: images side by side above its `repr`. It is quick, and never fails.

Names may come out of the files of strangers, so all text is escaped here.
"""

import base64
import html as escaping
import io
from collections.abc import Iterable, Mapping
from functools import singledispatch
from itertools import islice
from typing import Any

import numpy as np
import torch
from PIL import Image

from mi_splat.bounds import bounds, near_plane
from mi_splat.camera_sets import framing, orbit
from mi_splat.cameras import Camera, View, ViewSet
from mi_splat.comparison.compare import Comparison
from mi_splat.errors import InvalidValueError, listed, one_line
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import SplatScene
from mi_splat.training.loop import Fit
from mi_splat.variant import device_of, variant_kept

HEIGHT, WIDTH = 144, 480
"""Pixels that an image of a card has at most."""
_MOST_IMAGES = 4


def html(value: object) -> str:
    """The card of a value."""
    try:
        return _card(repr(value), images(value))
    except Exception as error:  # noqa: BLE001 - whatever is wrong with a value, a notebook has to be able to show it
        return _card(f"{value!r} (no picture: {type(error).__name__})", ())


@singledispatch
def images(value: object) -> Iterable[str]:
    """The images of a value, as HTML."""
    return ()


images.register(GaussianScene, lambda value: [_rendered(value)])
images.register(Fit, lambda value: [_rendered(value.scene)])
images.register(View, lambda value: [image(value.image)])


@images.register
def _(value: SplatScene) -> Iterable[str]:
    cameras = islice(value.cameras.items(), _MOST_IMAGES)
    return [_rendered(value.scene, camera, name) for name, camera in cameras] or [_rendered(value.scene)]


@images.register
def _(value: ViewSet) -> Iterable[str]:
    numbers = range(0, len(value), -(-len(value) // _MOST_IMAGES))
    return [image(value[number].image, f"view {number}") for number in numbers]


@images.register
def _(value: Comparison) -> Iterable[str]:
    rendered = next(iter(value.pictures.values()), {})
    return [image(pixels, name) for name, pixels in islice(rendered.items(), _MOST_IMAGES)]


class Pictures:
    """Images side by side, with their names below them, as a notebook shows them; `named` has each by its name."""

    def __init__(self, named: Mapping[str, Any], *, height: int = 192, width: int = WIDTH) -> None:
        self._images = [image(value, name, height=height, width=width) for name, value in named.items()]
        self._names = listed(named)

    def __repr__(self) -> str:
        return f"Pictures({self._names})"

    def _repr_html_(self) -> str:
        return _card("", self._images)


def image(pixels: Any, caption: str = "", *, height: int = HEIGHT, width: int = WIDTH) -> str:
    """An image (H, W, 3) with a caption below it, as HTML."""
    values = np.asarray(pixels.detach().cpu() if hasattr(pixels, "detach") else pixels)
    if values.ndim != 3 or values.shape[2] not in (3, 4) or 0 in values.shape:
        raise InvalidValueError.of("image", "shape (H, W, 3)", tuple(values.shape), "pass one of three channels")
    if values.dtype != np.uint8:
        values = (np.nan_to_num(values.astype(np.float32)).clip(0, 1) * 255).round().astype(np.uint8)
    small = Image.fromarray(np.ascontiguousarray(values[..., :3]))
    small.thumbnail((width, height), Image.Resampling.LANCZOS)
    buffer, text = io.BytesIO(), escaping.escape(one_line(caption))
    small.save(buffer, format="PNG", optimize=True)
    source = f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"
    # The class keeps the theme of a dark page from changing the colours.
    shown = (
        f'<img src="{source}" alt="{text or "an image"}" width="{small.width}" class="dark-light" style="height:auto">'
    )
    return f'<div>{shown}<div style="font-size:0.85em">{text}</div></div>'


def _card(facts: str, shown: Iterable[str]) -> str:
    """Images side by side, and a line of facts below them."""
    row = f'<div style="display:flex;flex-wrap:wrap;gap:8px">{"".join(shown)}</div>'
    line = escaping.escape(one_line(facts))
    return f'<div class="mi-splat-card">{row}<div style="font-family:monospace;font-size:0.85em">{line}</div></div>'


def _rendered(scene: GaussianScene, camera: Camera | None = None, caption: str = "") -> str:
    """A small image of a splat, from a camera or from where all of it shows."""
    scene = scene.detach()
    if camera is None:
        (centre, radius), size = bounds(scene), (192, HEIGHT)
        distance, focal = framing(radius, fov=45, size=size)
        (camera,) = orbit(centre, count=1, elevation=20, start=-60, distance=distance, focal=focal, size=size)
    with torch.no_grad(), variant_kept():
        render = Renderer(RenderSettings(background=(0.93, 0.93, 0.93), near=near_plane(scene, [camera])))
        return image(render(scene.to(device_of(render.variant)), camera), caption)
