"""Renders the image of a page: splats and photographs side by side, with
detections.
"""

import shlex
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn import functional

from mi_splat.cameras.camera import RenderFn
from mi_splat.io.formats.compressed_ply import morton_order
from mi_splat.io.images import quantise, to_bytes
from mi_splat.io.labels import write_label
from mi_splat.maths.metrics import psnr
from mi_splat.render.tile.frozen import between_stages
from mi_splat.scene import GaussianScene
from mi_splat.viewer.content import Content, Inspection, Inspector
from mi_splat.viewer.orbit import Orbit, camera_options
from mi_splat.viewer.picking import Picked, border, tinted
from mi_splat.viewer.session import (
    DIFFERENCE,
    Layout,
    Pace,
    Pixels,
    Step,
    ViewState,
    compose,
    difference,
    lay_out,
    panes,
    pictures_of,
)

# pixels of the largest full image; the browser enlarges it to a larger window
MOST_PIXELS = 1_500_000
# height of letters in a full image, and the smallest that can be read, in pixels
LETTERS = 15
SMALLEST_LETTERS = 7
NO_PICTURE = 0.2  # grey level in place of a missing photograph
# follows the title of an image with fewer pixels or Gaussians than there are
PREVIEW = " (preview)"
LARGEST_THINNING = 64  # a coarse image shows at least one of so many Gaussians


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Painting:
    """An image of a page, (H, W, 3), and what was found in it; a coarse one shows one
    of `every` Gaussians.
    """

    pixels: Pixels
    inspections: Mapping[str, Inspection]
    every: int


class Painter:
    """Renders images of a content; the inspector looks at those of a resting
    camera.
    """

    def __init__(
        self, content: Content, render: RenderFn, inspector: Inspector | None = None
    ) -> None:
        self.content = content
        self.render = render
        self.inspector = inspector
        self._splats = {splat.name: Thinned(splat.scene) for splat in content.splats}
        self._tinted, self._rows = dict[str, Thinned](), dict[str, int]()
        # of the inspector, so that it can be left alone with its image
        self._thread = ThreadPoolExecutor(1)
        self._last: tuple[Orbit, dict[str, Inspection]] | None = None

    def tint(self, picked: Picked | None) -> None:
        """Highlight an object in each splat with as many Gaussians, but not in
        differences and inspected images.
        """
        fits = [
            splat
            for splat in self.content.splats
            if picked is not None and picked.fits(splat.scene)
        ]
        self._tinted = {
            splat.name: Thinned(tinted(splat.scene, picked.mask))
            for splat in fits
            if picked is not None
        }
        self._rows = {
            splat.name: picked.row
            for splat in fits
            if picked is not None and picked.row is not None
        }

    def paint(self, state: ViewState, step: Step, pace: Pace) -> Painting:
        """The image that a step of a session needs."""
        full = within(state.canvas, MOST_PIXELS)
        names = self.content.names
        layout = self.layout(state, pace.size(full, step))
        shown = list(
            dict.fromkeys(
                name
                for pane in panes(state.mode, names)
                for name in pictures_of(pane, names)
            )
        )
        if step is Step.INSPECTED:
            inspections = {name: self.inspect(name, state.orbit) for name in shown}
        else:
            inspections = {}
        splats = self._splats
        every = 1
        # two splats with different Gaussians would differ everywhere
        if state.mode != DIFFERENCE:
            splats = {**self._splats, **self._tinted}
            if step in (Step.COARSE, Step.HALF):
                most = max(
                    (
                        len(splat.scene)
                        for splat in self.content.splats
                        if splat.name in shown
                    ),
                    default=1,
                )
                every = thinning(most, layout.size[0] * layout.size[1])
        pictures = {}
        for name in shown:
            scene = splats[name](every) if name in splats else None
            pictures[name] = to_bytes(
                self.sized_picture(name, state.orbit, layout.size, scene)
            )
        scale = layout.canvas[0] / full[0]
        made = list[Pixels]()
        mark = PREVIEW if every > 1 or scale < 1 else ""
        letters = max(LETTERS * scale, SMALLEST_LETTERS)
        for pane in panes(state.mode, names):
            if pane == DIFFERENCE:
                pixels = difference(*pictures.values())
            else:
                pixels = pictures[pane]
            image = Image.fromarray(np.ascontiguousarray(pixels))
            draw = ImageDraw.Draw(image)
            if pane in inspections:
                inspections[pane].draw(
                    draw, image.width / self.content.size_at(state.orbit)[0]
                )
            if pane in self._rows:
                outline = border(
                    self.content.splat(pane).scene,
                    self._rows[pane],
                    state.orbit.camera(layout.size),
                )
                draw.line([*map(tuple, outline.tolist())], fill="white", width=2)
            write_label(
                draw,
                (0.4 * letters, image.height - 1.9 * letters),
                pane + mark,
                "#000000",
                size=letters,
            )
            made.append(np.asarray(image))
        return Painting(
            pixels=compose(made, layout), inspections=inspections, every=every
        )

    def layout(self, state: ViewState, canvas: tuple[int, int] | None = None) -> Layout:
        """Where images stand on a canvas of the window's shape; None is the
        largest.
        """
        full, (width, height) = (
            within(state.canvas, MOST_PIXELS),
            self.content.size_at(state.orbit),
        )
        canvas = canvas or full
        count = len(panes(state.mode, self.content.names))
        return lay_out(
            canvas, width / height, count, gap=round(4 * canvas[0] / full[0])
        )

    def picture(self, name: str, orbit: Orbit) -> Tensor:
        """(H, W, 3) the image that is inspected, with 8 bits."""
        return quantise(self.sized_picture(name, orbit, self.content.size_at(orbit)))

    def inspect(self, name: str, orbit: Orbit) -> Inspection:
        """What is found in the image of a splat; that of the last camera is kept."""
        assert self.inspector is not None
        if self._last is None or self._last[0] != orbit:
            self._last = (orbit, {})
        inspections = self._last[1]
        if name not in inspections:
            found = self._thread.submit(self.inspector, self.picture(name, orbit))
            while not wait([found], timeout=0.02).done:
                between_stages.get()()
            inspections[name] = found.result()
        return inspections[name]

    def commands(self, orbit: Orbit) -> dict[str, str]:
        """For each splat the command that makes the inspected image."""
        content = self.content
        commands = dict[str, str]()
        for splat in content.splats:
            size = content.size_at(orbit)
            up = content.up
            options = camera_options(
                orbit, size, settings=content.settings, up=up, path=splat.path
            )
            commands[splat.name] = shlex.join(
                ["mi-splat", "render", str(splat.path), *options]
            )
        return commands

    def similarity(self, orbit: Orbit) -> float | None:
        """PSNR in dB between the two inspected images; None for one, or where they
        are equal.
        """
        photographs = self.content.photographs
        if len(self.content.names) < 2 or (
            photographs and self._photograph(orbit) is None
        ):
            return None
        first, second = (self.picture(name, orbit) for name in self.content.names)
        if photographs is not None:
            counts = photographs.counting_pixels(self.content.camera_name(orbit))
            if counts is not None:
                mask = _resized(counts[..., None], self.content.size_at(orbit))
                second = first + mask * (second - first)
        if torch.equal(first, second):
            return None
        return float(psnr(first, second))

    def comparison(self, orbit: Orbit) -> str:
        """How similar the two images are, in words; empty for one."""
        names = self.content.names
        photographs = self.content.photographs
        if photographs is not None and self._photograph(orbit) is None:
            return (
                f"There is no {photographs.name} from here: choose one of the cameras."
            )
        if len(names) < 2:
            return ""
        similarity = self.similarity(orbit)
        if similarity is None:
            return "From here both images are the same."
        return f"PSNR of {' and '.join(names)} from here: {similarity:.1f} dB"

    def sized_picture(
        self,
        name: str,
        orbit: Orbit,
        size: tuple[int, int],
        scene: GaussianScene | None = None,
    ) -> Tensor:
        """(H, W, 3) a splat or a photograph; grey if there is no photograph."""
        if name in self._splats:
            with torch.no_grad():
                return self.render(scene or self._splats[name](1), orbit.camera(size))
        taken = self._photograph(orbit)
        if taken is None:
            return torch.full((size[1], size[0], 3), NO_PICTURE)
        return _resized(taken, size)

    def _photograph(self, orbit: Orbit) -> Tensor | None:
        photographs = self.content.photographs
        if photographs is None:
            return None
        return photographs.from_camera(self.content.camera_name(orbit))


class Thinned:
    """A scene with fewer and larger Gaussians, made when they are first needed."""

    def __init__(self, scene: GaussianScene) -> None:
        self._scenes, self._order = {1: scene}, Tensor()

    def __call__(self, every: int) -> GaussianScene:
        """One of `every` neighbours along a Morton curve, enlarged so that surfaces
        stay closed.
        """
        if every not in self._scenes:
            scene = self._scenes[1]
            if not len(self._order):
                self._order = torch.as_tensor(
                    morton_order(scene.means.detach().cpu().numpy())
                )
            rows = self._order[every // 2 :: every].to(scene.means.device)
            means, scales, *rest = (tensor[rows] for tensor in scene.tensors())
            self._scenes[every] = GaussianScene.unchecked(
                means, scales * every**0.5, *rest
            )
        return self._scenes[every]


def thinning(count: int, pixels: int) -> int:
    """The power of two that leaves at most one Gaussian a pixel."""
    every = 1
    while every < LARGEST_THINNING and count > pixels * every:
        every *= 2
    return every


def _resized(picture: Tensor, size: tuple[int, int]) -> Tensor:
    """(H, W, C) an image of another width and height; the same if it has them."""
    if tuple(picture.shape[:2]) == size[::-1]:
        return picture
    pixels = picture.permute(2, 0, 1)[None]
    resized = functional.interpolate(
        pixels, size[::-1], mode="bilinear", antialias=True, align_corners=False
    )
    return resized[0].permute(1, 2, 0).clamp(0, 1)


def within(canvas: tuple[int, int], pixels: int) -> tuple[int, int]:
    """A canvas of this shape with at most so many pixels."""
    width, height = canvas
    factor = min(1.0, (pixels / (width * height)) ** 0.5)
    return max(1, round(width * factor)), max(1, round(height * factor))
