"""Functions for `on_step`: a progress bar for terminals and notebooks, and the curves of TensorBoard.

For instance::

    with bar(config.steps + 1, "attack") as on_step:
        result = attack(..., on_step=on_step)

An `on_step` of this library gets either a step that has figures (a search, a training), or two numbers: what is done,
and what is wanted.
"""

from __future__ import annotations

import importlib.util
import warnings
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from mi_splat.errors import MiSplatError, install, printable


class Measured(Protocol):
    """A step with figures."""

    @property
    def done(self) -> int:
        """Number of the step."""
        ...

    @property
    def figures(self) -> Mapping[str, float]:
        """What was measured in it, by name."""
        ...


class Listener(Protocol):
    """What may be passed as `on_step`."""

    def __call__(self, step: Measured | int, wanted: int | None = None, /) -> None:
        """Hear of a step: one with figures, or how many are done and how many are wanted."""
        ...


class Bar:
    """A progress bar of tqdm: of widgets in a notebook that has them, of text elsewhere. Made by `bar`."""

    def __init__(self, total: int | None, text: str) -> None:
        with warnings.catch_warnings():  # a notebook without widgets gets a bar of text, which is as good
            warnings.simplefilter("ignore")
            from tqdm.auto import tqdm

        self._bar = tqdm(total=total, desc=printable(text), dynamic_ncols=True)

    def __call__(self, step: Measured | int, wanted: int | None = None, /) -> None:
        """Move on to a step."""
        if isinstance(step, int):
            self._bar.total, done = wanted, step
        else:
            # The steps of a second run begin at 0 again, those of a training that goes on do not begin there.
            done = max(self._bar.n + 1, step.done)
            self._bar.set_postfix({name: f"{value:.3g}" for name, value in step.figures.items()}, refresh=False)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()

    def __enter__(self) -> Bar:
        """The bar itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the bar."""
        self.close()


def bar(total: int | None = None, text: str = "") -> Bar:
    """A progress bar, to be passed as `on_step`."""
    return Bar(total, text)


def tensorboard(folder: str | Path) -> Callable[..., None]:
    """Curves of all figures for TensorBoard, to be passed as `on_step`."""
    if importlib.util.find_spec("tensorboard") is None:
        raise MiSplatError.of("tensorboard", "the package", "none", install("tensorboard"))
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder))

    def on_step(step: Measured) -> None:
        for name, value in step.figures.items():
            writer.add_scalar(name, value, step.done)
        writer.flush()

    weakref.finalize(on_step, writer.close)
    return on_step


def together(*listeners: Callable[..., object]) -> Callable[..., Any]:
    """Several functions as one `on_step`."""

    def on_step(*step: object) -> bool:
        answers = [listener(*step) for listener in listeners]  # each hears of it, whatever the others say
        return any(map(bool, answers))

    return on_step
