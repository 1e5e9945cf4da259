"""A page that follows a training: the splat so far next to photographs, its curves, and a button to pause it.

All of it happens between two steps, in the thread of the training, which is the same with and without a page.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from mi_splat.datasets import Dataset, DatasetError
from mi_splat.io.picture_files import PictureFileError
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.training.loop import Progress, TrainState
from mi_splat.viewer.content import Content, ShownSplat, content_of_photographs, photographs_in
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.panel import as_html
from mi_splat.viewer.picking import Click
from mi_splat.viewer.runner import JobRunner

if TYPE_CHECKING:
    from mi_splat.viewer.server import Client, Page

REFRESH = 2.0  # seconds between two updates of the splat during a training
MOST_POINTS = 256  # points of a curve; those of a longer one are means
SPLAT = "splat so far"
Point = tuple[int, float]  # a step and a value
_BUTTON = {False: "Pause", True: "Continue"}


class LiveTraining(JobRunner):
    """What a page shows of a training of so many steps; it provides the hooks of the training."""

    label, tab, leads = "mi-splat train", "Training", True

    def __init__(self, painter: Painter, steps: int) -> None:
        super().__init__(painter)
        self.paused, self._steps = False, steps
        self.page: Page | None = None
        self._state: TrainState | None = None
        self._progress: Progress | None = None
        self._scores = self._unreadable = ""
        self._seen = (-1, 0.0)
        first = next(name for name, orbit in self.content.cameras.items() if orbit == self.content.start)
        self._loss, self._psnr = list[Point](), list[Point]()
        self.curves = {"loss": self._loss, f"PSNR of {first}, dB": self._psnr}

    def begin(self, state: TrainState) -> None:
        """Follow a run."""
        self._state = state

    def note(self, progress: Progress) -> None:
        """Record a step."""
        self._progress = progress
        self._loss.append((progress.iteration, progress.loss))
        if progress.held_out is not None:
            psnr = progress.held_out.psnr
            self._scores = f"All held-out pictures at step {progress.iteration:,}: PSNR {psnr:.2f} dB"

    def hold(self) -> bool:
        """Serve the page between two steps; whether the training is to wait."""
        if self.page is not None:
            self.page.turn(wait=0.05 if self.paused else 0.0)
        return self.paused

    def toggle(self) -> None:
        """Pause the training, or continue it."""
        self.paused = not self.paused

    def turn(self) -> bool:
        """As in `JobRunner`; now and then it updates the splat."""
        changed, progress = super().turn(), self._progress
        step, when = self._seen
        if progress is None or progress.iteration == step:
            return changed
        if not self.paused and time.monotonic() - when < REFRESH:
            return changed
        assert self._state is not None
        with torch.no_grad():
            scene = self._state.scene()
        tensors = (tensor.detach().cpu().clone() for tensor in scene.tensors())
        self.painter.exchange(SPLAT, GaussianScene.unchecked(*tensors))
        try:
            similarity, self._unreadable = self.painter.similarity(self.content.start), ""
        except (DatasetError, PictureFileError) as error:  # ends a training that needs the photograph
            similarity, self._unreadable = None, str(error)
        if similarity is not None:
            self._psnr.append((progress.iteration, similarity))
        self.revision += 1
        self._seen = (progress.iteration, time.monotonic())
        return True

    @property
    def remarks(self) -> list[str]:
        """The progress of the training in words."""
        if self._progress is None:
            return ["The training begins."]
        step = f"Step {self._progress.iteration:,} of {self._steps:,}{', paused' if self.paused else ''}"
        now = f"loss {self._progress.loss:.4f}, {self._progress.count:,} Gaussians"
        return [step, now, *filter(None, (self._scores, self._unreadable))]

    def pick(self, click: Click) -> None:
        """Nothing is selected, because Gaussians come and go."""

    def panel(self, gui: Any, client: Client, wake: Callable[[], None]) -> TrainingPanel:
        """As in `JobRunner`."""
        return TrainingPanel(gui, self, wake)


class TrainingPanel:
    """The controls of a training in one window."""

    def __init__(self, gui: Any, training: LiveTraining, wake: Callable[[], None]) -> None:
        self._training = training
        self._remarks = gui.add_html("")
        self._button = gui.add_button(_BUTTON[False])
        self._plots = [
            gui.add_uplot(
                curve_data(points),
                ({"label": "step"}, {"label": title, "stroke": "#2060c0"}),
                title=title,
                scales={"x": {"time": False}},
                aspect=2.0,
            )
            for title, points in training.curves.items()
        ]

        @self._button.on_click  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:
            training.later(training.toggle)
            wake()

        self.follow()

    def follow(self) -> None:
        """Show the progress of the training."""
        training = self._training
        self._remarks.content = as_html([("", line) for line in training.remarks])
        self._button.label = _BUTTON[training.paused]
        for plot, points in zip(self._plots, training.curves.values(), strict=True):
            plot.data = curve_data(points)

    def follow_camera(self) -> None:
        """Nothing depends on the camera."""


def curve_data(points: Sequence[Point]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps and values of at most MOST_POINTS points."""
    parts = np.array_split(np.array(points or [(0, np.nan)]), min(max(len(points), 1), MOST_POINTS))
    steps, values = np.stack([part.mean(0) for part in parts], axis=1)
    return steps, values


def training_content(
    sets: Sequence[Dataset], start: GaussianScene, *, dataset: Path, out: Path, settings: RenderSettings
) -> Content:
    """A splat in training next to the photographs, from the first held-out camera if there is one."""
    splat, title = ShownSplat(name=SPLAT, scene=start, path=out), f"Training on {dataset}, into {out.parent}"
    return content_of_photographs(title, settings, *photographs_in(sets, dataset), splat)
