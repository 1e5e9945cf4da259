"""A page that follows a training: the splat so far beside photographs, its curves, and a button to stop and go on.

All of it happens between two steps, in the thread of the training, which is the same with and without a page.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from mi_splat.datasets import Dataset, DatasetError
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.training.loop import Progress, TrainState
from mi_splat.viewer.bench import Bench
from mi_splat.viewer.bench_panel import Visit
from mi_splat.viewer.composition import Pixels
from mi_splat.viewer.exhibit import Exhibit, ShownSplat
from mi_splat.viewer.page import Page
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.panel import as_html
from mi_splat.viewer.photographs import photographs_in
from mi_splat.viewer.picking import Click

REFRESH = 2.0
"""Seconds between two looks at the splat while it is trained."""
MOST_POINTS = 256
"""Points of a curve; of a longer one each is the mean of several."""
SPLAT = "splat so far"
_CHART = (320, 130)
"""Width and height of a curve in pixels."""


@dataclass(slots=True)
class Curve:
    """Numbers over the steps, thinned out evenly.

    Attributes:
        title: What they are.
        points: Step and number, each the mean of as many.
    """

    title: str
    points: list[tuple[float, float]] = field(default_factory=list)
    _each: int = 1
    _rest: list[tuple[float, float]] = field(default_factory=list)

    def add(self, step: int, value: float) -> None:
        """Add the number of a later step."""
        self._rest.append((step, value))
        if len(self._rest) < self._each:
            return
        self.points.append(_mean(self._rest))
        self._rest.clear()
        if len(self.points) == MOST_POINTS:
            self.points = [_mean(self.points[i : i + 2]) for i in range(0, MOST_POINTS, 2)]
            self._each *= 2


def _mean(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    steps, values = zip(*points, strict=True)
    return sum(steps) / len(points), sum(values) / len(points)


def draw_curves(curves: Sequence[Curve]) -> Pixels:
    """(H, W, 3) curves below one another, from step 0 to now, each with its largest and its least number."""
    shown = [curve for curve in curves if curve.points]
    width, height = _CHART
    image = Image.new("RGB", (width, max(height * len(shown), 1)), "#ffffff")
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(size=12)
    for number, curve in enumerate(shown):
        top, values = height * number, [value for _, value in curve.points]
        low, high, last = min(values), max(values), max(curve.points[-1][0], 1.0)
        frame = (6, top + 20, width - 50, top + height - 8)
        across, down = frame[2] - frame[0], frame[3] - frame[1]
        line = [
            (frame[0] + across * step / last, frame[3] - down * ((value - low) / (high - low) if high > low else 0.5))
            for step, value in curve.points
        ]
        draw.text((frame[0], top + 2), f"{curve.title}: {values[-1]:.4g}", fill="#000000", font=font)
        draw.line((frame[0], frame[3], frame[2], frame[3]), fill="#808080")
        for value, y in {high: frame[1] - 4, low: frame[3] - 12}.items():
            draw.text((frame[2] + 4, y), f"{value:.3g}", fill="#606060", font=font)
        draw.line(line, fill="#2060c0", width=2)
        draw.ellipse((line[-1][0] - 2, line[-1][1] - 2, line[-1][0] + 2, line[-1][1] + 2), fill="#2060c0")
    return np.asarray(image)


class Live(Bench):
    """What a page shows of a training.

    Args:
        painter: Shows `training_exhibit`.
        steps: Of the whole training.

    Attributes:
        waiting: Whether the training is to wait.
    """

    label, tab, leads = "mi-splat train", "Training", True

    def __init__(self, painter: Painter, steps: int) -> None:
        super().__init__(painter)
        self.waiting, self._steps = False, steps
        self._state: TrainState | None = None
        self._line: Progress | None = None
        self._scores = self._unreadable = ""
        self._seen = (-1, 0.0)
        first = next(name for name, orbit in self.exhibit.cameras.items() if orbit == self.exhibit.start)
        self._loss, self._psnr = Curve("loss"), Curve(f"PSNR of {first}, dB")

    def begin(self, state: TrainState) -> None:
        """Follow a run."""
        self._state = state

    def note(self, line: Progress) -> None:
        """Hear of a step."""
        self._line = line
        self._loss.add(line.iteration, line.loss)
        if line.held_out is not None:
            self._scores = f"All held-out pictures at step {line.iteration:,}: PSNR {line.held_out.psnr:.2f} dB"

    def toggle(self) -> None:
        """Make the training wait, or go on."""
        self.waiting = not self.waiting

    def turn(self) -> bool:
        """As in `Bench`; now and then it looks at the splat."""
        changed, line = super().turn(), self._line
        step, when = self._seen
        if line is None or line.iteration == step or not (self.waiting or time.monotonic() - when >= REFRESH):
            return changed
        assert self._state is not None
        with torch.no_grad():
            scene = self._state.scene()
        tensors = (tensor.detach().cpu().clone() for tensor in scene.tensors())
        self.painter.exchange(SPLAT, GaussianScene.unchecked(*tensors))
        try:
            likeness, self._unreadable = self.painter.likeness(self.exhibit.start), ""
        except DatasetError as error:  # which ends the training where it needs that photograph itself
            likeness, self._unreadable = None, str(error)
        if likeness is not None:
            self._psnr.add(line.iteration, likeness)
        self.tints += 1
        self._seen = (line.iteration, time.monotonic())
        return True

    @property
    def remarks(self) -> list[str]:
        """Where the training stands, in words."""
        if self._line is None:
            return ["The training begins."]
        step = f"Step {self._line.iteration:,} of {self._steps:,}{', stopped' if self.waiting else ''}"
        now = f"loss {self._line.loss:.4f}, {self._line.count:,} Gaussians"
        return [step, now, *filter(None, (self._scores, self._unreadable))]

    @property
    def share(self) -> float:
        """Part of the steps that is done."""
        return 0.0 if self._line is None else self._line.iteration / self._steps

    @property
    def curves(self) -> Pixels:
        """(H, W, 3) loss, and how like its photograph the first picture is."""
        return draw_curves((self._loss, self._psnr))

    def pick(self, click: Click) -> None:
        """Nothing is picked, since Gaussians come and go."""

    def panel(self, gui: Any, visit: Visit, wake: Callable[[], None]) -> LivePanel:
        """As in `Bench`."""
        return LivePanel(gui, self, wake)


class LivePanel:
    """The controls of a training, for one visitor.

    Args:
        gui: viser's interface for this visitor.
        live: The training.
        wake: Called when something was asked for.
    """

    def __init__(self, gui: Any, live: Live, wake: Callable[[], None]) -> None:
        self._live = live
        self._words, self._bar = gui.add_html(""), gui.add_progress_bar(0.0)
        self._button = gui.add_button(_LABELS[False])
        self._curves = gui.add_image(live.curves, format="png")

        @self._button.on_click  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:
            live.later(live.toggle)
            wake()

        self.follow()

    def follow(self) -> None:
        """Show where the training stands."""
        live = self._live
        self._words.content = as_html([("", line) for line in live.remarks])
        self._bar.value, self._button.label = 100 * live.share, _LABELS[live.waiting]
        self._curves.image = live.curves

    def tell(self) -> None:
        """Nothing depends on the camera."""


_LABELS = {False: "Stop", True: "Go on"}


def training_exhibit(
    sets: Sequence[Dataset], start: GaussianScene, *, dataset: Path, out: Path, settings: RenderSettings
) -> Exhibit:
    """A splat that is being trained beside the photographs, from the first held-out camera if there is one."""
    orbits, photographs = photographs_in(sets, dataset)
    first = next(iter(orbits.values()))
    splat = ShownSplat(name=SPLAT, scene=start, path=out, file_settings=replace(settings, near=RenderSettings().near))
    return Exhibit(
        title=f"Training on {dataset}, into {out.parent}",
        splats=(splat,),
        settings=settings,
        start=first,
        size=first.camera_size or (640, 480),
        cameras=orbits,
        photographs=photographs,
    )


class Follower:
    """A training that a page follows; what it makes of the training's hooks.

    Args:
        live: What is shown.
        page: Where.
    """

    def __init__(self, live: Live, page: Page) -> None:
        self._live, self._page = live, page
        self.begin, self.note = live.begin, live.note

    def hold(self) -> bool:
        """Do what the page asks for between two steps."""
        self._page.turn(wait=0.05 if self._live.waiting else 0.0)
        return self._live.waiting
