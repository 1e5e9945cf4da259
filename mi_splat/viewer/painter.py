"""Makes the pictures of a page: renders, draws lines and findings, and puts them together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from mi_splat.bounds import bounds
from mi_splat.cameras import Camera, RenderFn
from mi_splat.io.images import quantise, to_bytes
from mi_splat.labels import write_label
from mi_splat.metrics import psnr
from mi_splat.scene import GaussianScene
from mi_splat.viewer.command import render_command
from mi_splat.viewer.composition import DIFFERENCE, SPLIT, Layout, Pixels, compose, lay_out, needed, pane_pixels, panes
from mi_splat.viewer.exhibit import Exhibit, Inspection, Inspector
from mi_splat.viewer.lines import draw_lines
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.picking import tinted
from mi_splat.viewer.session import Pace, Step, ViewState
from mi_splat.viewer.thinning import Thinned, thinning

MOST_PIXELS = 1_500_000
"""Pixels of the largest full picture; the browser enlarges it where its window has more."""
LETTERS = 15
"""Height of letters in a full picture, pixels."""
SMALLEST_LETTERS = 7
"""Height of letters below which nobody could read them."""
PREVIEW = " (preview)"
"""What stands behind the title of a picture that has fewer pixels or Gaussians than there are."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Painting:
    """One picture of the page.

    Attributes:
        pixels: (H, W, 3) uint8, of the shape of the page's place for pictures.
        inspections: Of each splat that was inspected; empty while the camera moves.
        every: Of how many Gaussians it shows one; 1 except in coarse pictures.
    """

    pixels: Pixels
    inspections: Mapping[str, Inspection]
    every: int


class Painter:
    """Makes pictures of an exhibit.

    Args:
        exhibit: What is shown.
        render: The renderer.
        inspector: Looks at pictures of a resting camera, if there is one.
    """

    def __init__(self, exhibit: Exhibit, render: RenderFn, inspector: Inspector | None = None) -> None:
        self.exhibit, self.render, self.inspector = exhibit, render, inspector
        self._thinned = {splat.name: Thinned(splat.scene) for splat in exhibit.splats}
        self._tinted = dict[str, Thinned]()
        self._middles = {splat.name: bounds(splat.scene)[0] for splat in exhibit.splats}
        self._last: tuple[Orbit, dict[str, Inspection]] | None = None

    def tint(self, mask: Tensor | None) -> None:
        """Show Gaussians, (N,) bool, in another colour from now on, in each splat that has as many; None shows none.

        A heat map, and what is inspected, never has it.
        """
        fits = [splat for splat in self.exhibit.splats if mask is not None and len(splat.scene) == len(mask)]
        self._tinted = {splat.name: Thinned(tinted(splat.scene, mask)) for splat in fits if mask is not None}

    def paint(self, state: ViewState, step: Step, pace: Pace) -> Painting:
        """The picture that a step of a session asks for.

        Args:
            state: What is to be seen.
            step: Which picture of it.
            pace: How coarse a coarse picture is.
        """
        full = within(state.canvas, MOST_PIXELS)
        names = panes(state.show, self.exhibit.names)
        layout = self.layout(state, pace.size(full) if step is Step.COARSE else full)
        scale = layout.canvas[0] / full[0]
        shown = list(dict.fromkeys(name for pane in names for name in needed(pane, self.exhibit.names)))
        inspections = {name: self.inspect(name, state.orbit) for name in shown} if step is Step.INSPECTED else {}
        camera = state.orbit.camera(layout.size)
        every = 1
        # Two splats without the same Gaussians would differ where nothing does.
        if step is Step.COARSE and DIFFERENCE not in names:
            most = max(len(self.exhibit.splat(name).scene) for name in shown)
            every = thinning(most, camera.width * camera.height * pace.richness)
        splats = self._thinned if DIFFERENCE in names else {**self._thinned, **self._tinted}
        pictures = {name: to_bytes(self._render(splats[name](every), camera)) for name in shown}
        letters, mark = max(LETTERS * scale, SMALLEST_LETTERS), PREVIEW if every > 1 or scale < 1 else ""
        made = [self._pane(pane, pictures, inspections, camera, state, letters, mark) for pane in names]
        return Painting(pixels=compose(made, layout), inspections=inspections, every=every)

    def layout(self, state: ViewState, canvas: tuple[int, int] | None = None) -> Layout:
        """Where pictures stand in a place of the shape of the page's; None is as large as it gets."""
        full, (width, height) = within(state.canvas, MOST_PIXELS), self.exhibit.size
        canvas = canvas or full
        count = len(panes(state.show, self.exhibit.names))
        return lay_out(canvas, width / height, count, gap=round(4 * canvas[0] / full[0]))

    def picture(self, name: str, orbit: Orbit) -> Tensor:
        """(H, W, 3) the picture of a splat that is inspected: of the exhibit's size, and of 8 bits."""
        return quantise(self._render(self._thinned[name](1), orbit.camera(self.exhibit.size)))

    def inspect(self, name: str, orbit: Orbit) -> Inspection:
        """What is found in the picture of a splat; of the last camera it is remembered."""
        assert self.inspector is not None
        if self._last is None or self._last[0] != orbit:
            self._last = (orbit, {})
        inspections = self._last[1]
        if name not in inspections:
            inspections[name] = self.inspector(self.picture(name, orbit))
        return inspections[name]

    def commands(self, orbit: Orbit) -> dict[str, str]:
        """For each splat the command that makes the picture which is inspected."""
        exhibit = self.exhibit
        return {
            splat.name: render_command(
                splat.path,
                orbit,
                exhibit.size,
                middle=self._middles[splat.name],
                settings=exhibit.settings,
                file_settings=splat.file_settings,
                up=exhibit.up,
            )
            for splat in exhibit.splats
        }

    def likeness(self, orbit: Orbit) -> float | None:
        """PSNR in dB between the pictures of the two splats that are inspected; None of one splat, or where equal."""
        if len(self.exhibit.splats) < 2:
            return None
        first, second = (self.picture(name, orbit) for name in self.exhibit.names)
        return None if torch.equal(first, second) else float(psnr(first, second))

    def _render(self, scene: GaussianScene, camera: Camera) -> Tensor:
        with torch.no_grad():
            return self.render(scene, camera)

    def _pane(
        self,
        pane: str,
        pictures: Mapping[str, Pixels],
        inspections: Mapping[str, Inspection],
        camera: Camera,
        state: ViewState,
        letters: float,
        mark: str,
    ) -> Pixels:
        """The pixels of one pane with everything drawn into it."""
        parts = {name: pictures[name] for name in needed(pane, self.exhibit.names)}
        if set(parts) & set(inspections) and pane != DIFFERENCE:
            parts = {name: self._marked(pixels, inspections[name]) for name, pixels in parts.items()}
        image = Image.fromarray(np.ascontiguousarray(pane_pixels(pane, parts, split=state.split)))
        draw = ImageDraw.Draw(image)
        for name in sorted(state.lines & set(self.exhibit.lines)):
            draw_lines(draw, self.exhibit.lines[name], camera)
        for left, text in _titles(pane, self.exhibit.names, image.width, letters):
            write_label(draw, (left, image.height - 1.9 * letters), text + mark, "#000000", size=letters)
        return np.asarray(image)

    def _marked(self, pixels: Pixels, inspection: Inspection) -> Pixels:
        """A picture with what was found in it."""
        image = Image.fromarray(pixels)
        inspection.draw(ImageDraw.Draw(image), image.width / self.exhibit.size[0])
        return np.asarray(image)


def _titles(pane: str, names: Sequence[str], width: int, letters: float) -> list[tuple[float, str]]:
    """What is written at the bottom of a pane, and how far from its left."""
    edge = 0.4 * letters
    if pane == SPLIT:
        return [(edge, names[0]), (width, names[1])]
    return [(edge, pane)]


def within(canvas: tuple[int, int], pixels: int) -> tuple[int, int]:
    """A place of this shape with at most so many pixels."""
    width, height = canvas
    factor = min(1.0, (pixels / (width * height)) ** 0.5)
    return max(1, round(width * factor)), max(1, round(height * factor))
