"""The picture of a training in the model cards: losses and validation mAP by epoch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_splat.errors import InvalidValueError, MiSplatError, install, message
from mi_splat.io.fields import Fields
from mi_splat.io.parsing import DocumentReader

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def read_history(path: Path) -> list[dict[str, Any]]:
    """The epochs of a curves.json, or of the JSON beside a model card.

    Raises:
        InvalidValueError: The file holds no such history, or no epoch with a validation.
    """
    do = "name the curves.json of a training"
    reader = DocumentReader(expected="JSON with a history", do=do)
    found = reader.read_json(path)
    if "history" not in found:
        raise reader.broken(str(path), "none")
    records = Fields(found, str(path), InvalidValueError, do).objects("history")
    epochs = [dict(record.values) for record in records if record.whole("epoch", 0, 1 << 31) > 0]
    if not any("validation" in record for record in epochs):
        raise InvalidValueError(message(f"file {path}", "an epoch with a validation", "none", "train on"))
    return epochs


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches.

    Raises:
        MiSplatError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MiSplatError(message("plot", "the package matplotlib", "none", install("figures"))) from error
    return Figure(figsize=(width, height), dpi=100, layout="constrained")


def draw_curves(path: Path) -> Figure:
    """Losses, and average precision by class, over the epochs of a history.

    Raises:
        InvalidValueError: See `read_history`.
        MiSplatError: matplotlib is not installed.
    """
    epochs = read_history(path)
    figure = new_figure(9, 3.2)
    left, right = figure.subplots(1, 2)
    for name in epochs[0]["losses"]:
        left.plot([r["epoch"] for r in epochs], [r["losses"][name] for r in epochs], label=name.replace("_", " "))
    left.set(xlabel="epoch", ylabel="training loss", yscale="log")
    left.legend(fontsize=8)
    scored = [record for record in epochs if "validation" in record]
    for name in scored[-1]["validation"]["ap"]:
        values = [record["validation"]["ap"][name] for record in scored]
        right.plot([r["epoch"] for r in scored], values, linewidth=1, label=name)
    right.plot([r["epoch"] for r in scored], [r["map"] for r in scored], "k", linewidth=2.5, label="mean")
    right.set(xlabel="epoch", ylabel="AP at IoU 0.5, validation", ylim=(0, 1.02))
    right.legend(fontsize=8, ncols=2)
    return figure
