"""Makes the pictures of a page: renders, draws lines and findings, and puts them together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn import functional

from mi_splat.bounds import bounds
from mi_splat.cameras import Camera, RenderFn
from mi_splat.directions import Point
from mi_splat.io.images import quantise, to_bytes
from mi_splat.labels import write_label
from mi_splat.metrics import psnr
from mi_splat.scene import GaussianScene
from mi_splat.training.losses import masked
from mi_splat.viewer.command import render_command
from mi_splat.viewer.composition import DIFFERENCE, SPLIT, Layout, Pixels, compose, lay_out, needed, pane_pixels, panes
from mi_splat.viewer.exhibit import Exhibit, Inspection, Inspector
from mi_splat.viewer.lines import draw_lines
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.picking import Picked, edges, tinted
from mi_splat.viewer.session import Pace, Step, ViewState
from mi_splat.viewer.thinning import Thinned, thinning

MOST_PIXELS = 1_500_000
"""Pixels of the largest full picture; the browser enlarges it where its window has more."""
LETTERS = 15
"""Height of letters in a full picture, pixels."""
SMALLEST_LETTERS = 7
"""Height of letters below which nobody could read them."""
NO_PICTURE = 0.2
"""Grey in the place of a photograph that there is not."""
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
        self._picked: Picked | None = None
        self._middles = dict[str, Point | None]()
        self._middles |= {splat.name: bounds(splat.scene)[0] for splat in exhibit.splats}
        self._last: tuple[Orbit, dict[str, Inspection]] | None = None

    def exchange(self, name: str, scene: GaussianScene) -> None:
        """Show other Gaussians as a splat from now on, which its file does not have yet."""
        splats = [replace(splat, scene=scene) if splat.name == name else splat for splat in self.exhibit.splats]
        self.exhibit = replace(self.exhibit, splats=tuple(splats))
        self._thinned[name], self._middles[name], self._last = Thinned(scene), None, None
        self._tinted = {}

    def tint(self, picked: Picked | None) -> None:
        """Show an object in another colour, and its box, in each splat that has as many Gaussians; None shows none.

        A heat map, and what is inspected, never has it.
        """
        self._picked, self._tinted = picked, {}

    def _made_tints(self) -> Mapping[str, Thinned]:
        """The splats with the object in another colour, made when they are first shown."""
        picked = self._picked
        if picked is not None and not self._tinted:
            fits = [splat for splat in self.exhibit.splats if picked.fits(splat.scene)]
            self._tinted = {splat.name: Thinned(tinted(splat.scene, picked.mask)) for splat in fits}
        return self._tinted

    def paint(self, state: ViewState, step: Step, pace: Pace) -> Painting:
        """The picture that a step of a session asks for."""
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
            most = max((len(splat.scene) for splat in self.exhibit.splats if splat.name in shown), default=1)
            every = thinning(most, camera.width * camera.height * pace.richness)
        thinned = self._thinned if DIFFERENCE in names else {**self._thinned, **self._made_tints()}
        splats = {name: made(every) for name, made in thinned.items() if name in shown}
        pictures = {
            name: to_bytes(self.sized_picture(name, state.orbit, layout.size, splats.get(name))) for name in shown
        }
        letters, mark = max(LETTERS * scale, SMALLEST_LETTERS), PREVIEW if every > 1 or scale < 1 else ""
        made = [self._pane(pane, pictures, inspections, camera, state, letters, mark) for pane in names]
        return Painting(pixels=compose(made, layout), inspections=inspections, every=every)

    def layout(self, state: ViewState, canvas: tuple[int, int] | None = None) -> Layout:
        """Where pictures stand in a place of the shape of the page's; None is as large as it gets."""
        full, (width, height) = within(state.canvas, MOST_PIXELS), self.exhibit.size_at(state.orbit)
        canvas = canvas or full
        count = len(panes(state.show, self.exhibit.names))
        return lay_out(canvas, width / height, count, gap=round(4 * canvas[0] / full[0]))

    def picture(self, name: str, orbit: Orbit) -> Tensor:
        """(H, W, 3) the picture that is inspected, rendered or photographed: of its stated size, and of 8 bits."""
        return quantise(self.sized_picture(name, orbit, self.exhibit.size_at(orbit)))

    def photograph(self, orbit: Orbit) -> Tensor | None:
        """(H, W, 3) what was photographed from a camera; None if nothing was."""
        exhibit = self.exhibit
        return None if exhibit.photographs is None else exhibit.photographs.from_camera(exhibit.camera_name(orbit))

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
                exhibit.size_at(orbit),
                middle=self._middles[splat.name],
                settings=exhibit.settings,
                file_settings=splat.file_settings,
                up=exhibit.up,
            )
            for splat in exhibit.splats
        }

    def likeness(self, orbit: Orbit) -> float | None:
        """PSNR in dB between the two pictures that are inspected; None of one, or where equal.

        What a photograph does not show at its border is no error, as in the scores of a training.
        """
        photographs = self.exhibit.photographs
        if len(self.exhibit.names) < 2 or (photographs and self.photograph(orbit) is None):
            return None
        first, second = (self.picture(name, orbit) for name in self.exhibit.names)
        if photographs is not None:
            shown = photographs.shown_from(self.exhibit.camera_name(orbit))
            if shown is not None:
                second = masked(second, first, _resized(shown[..., None], self.exhibit.size_at(orbit))[..., 0])
        return None if torch.equal(first, second) else float(psnr(first, second))

    def comparison(self, orbit: Orbit) -> str:
        """How like each other the two pictures are from here, in words; nothing of one."""
        names, photographs = self.exhibit.names, self.exhibit.photographs
        if photographs is not None and self.photograph(orbit) is None:
            return f"There is no {photographs.name} from here: choose one of the cameras."
        if len(names) < 2:
            return ""
        likeness = self.likeness(orbit)
        if likeness is None:
            return "From here both pictures are the same."
        return f"PSNR of {' and '.join(names)} from here: {likeness:.1f} dB"

    def sized_picture(
        self, name: str, orbit: Orbit, size: tuple[int, int], scene: GaussianScene | None = None
    ) -> Tensor:
        """(H, W, 3) a splat, or what was photographed; of a photograph that there is not, grey."""
        if name in self._thinned:
            with torch.no_grad():
                return self.render(scene or self._thinned[name](1), orbit.camera(size))
        taken = self.photograph(orbit)
        if taken is None:
            return torch.full((size[1], size[0], 3), NO_PICTURE)
        return _resized(taken, size)

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
            wide = self.exhibit.size_at(state.orbit)[0]
            parts = {name: self._marked(pixels, inspections[name], wide) for name, pixels in parts.items()}
        image = Image.fromarray(np.ascontiguousarray(pane_pixels(pane, parts, split=state.split)))
        draw = ImageDraw.Draw(image)
        for name in sorted(state.lines & set(self.exhibit.lines)):
            draw_lines(draw, self.exhibit.lines[name], camera)
        if self._picked is not None and pane != DIFFERENCE:
            draw_lines(draw, edges(self._picked.box), camera)
        for left, text in _titles(pane, self.exhibit.names, image.width, letters):
            write_label(draw, (left, image.height - 1.9 * letters), text + mark, "#000000", size=letters)
        return np.asarray(image)

    def _marked(self, pixels: Pixels, inspection: Inspection, width: int) -> Pixels:
        """A picture with what was found in it when it was so many pixels wide."""
        image = Image.fromarray(pixels)
        inspection.draw(ImageDraw.Draw(image), image.width / width)
        return np.asarray(image)


def _resized(picture: Tensor, size: tuple[int, int]) -> Tensor:
    """(H, W, C) a picture of another width and height; the same if it has them."""
    if tuple(picture.shape[:2]) == size[::-1]:
        return picture
    pixels = picture.permute(2, 0, 1)[None]
    resized = functional.interpolate(pixels, size[::-1], mode="bilinear", antialias=True, align_corners=False)
    return resized[0].permute(1, 2, 0).clamp(0, 1)


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
