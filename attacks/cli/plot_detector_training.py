"""`mi-splat plot-detector-training`: draw losses and validation mAP of a training by epoch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_splat.cli.console import show
from mi_splat.cli.flags import Positional
from mi_splat.errors import InvalidValueError, MiSplatError, install, message
from mi_splat.io.fields import Fields
from mi_splat.io.parsing import DocumentReader

if TYPE_CHECKING:
    from matplotlib.figure import Figure


EXAMPLES = ("plot-detector-training out/detector/curves.json --out curves.png",)
SEE_ALSO = ("train-detector",)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlotDetectorTrainingOptions:
    """Draw losses and validation mAP of a training by epoch; needs the extra `figures`."""

    curves: Positional[Path] = Path("out/detector/curves.json")
    """JSON file with the history of a training."""
    out: Path = Path("out/detector/curves.png")
    """Picture to write."""


def run(options: PlotDetectorTrainingOptions) -> int:
    """Draw one picture."""
    figure = draw_curves(options.curves)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out)
    show(str(options.out))
    return 0


def read_history(path: Path) -> list[dict[str, Any]]:
    """The epochs of a curves.json, or of the JSON beside a model card.

    Raises:
        InvalidValueError: The file holds no such history, or no epoch with a validation.
    """
    do = "name the curves.json of a training"
    reader = DocumentReader(expected="JSON with a history", do=do)
    document = reader.read_json(path)
    if "history" not in document:
        raise reader.broken(str(path), "none")
    records = Fields(document, str(path), InvalidValueError, do).objects("history")
    epochs = [dict(record.values) for record in records if record.whole("epoch", 0, 1 << 31) > 0]
    if not any("validation" in record for record in epochs):
        raise InvalidValueError(message(f"file {path}", "an epoch with a validation", "none", "train on"))
    return epochs


def draw_curves(path: Path) -> Figure:
    """Losses, and average precision by class, over the epochs of a history.

    Raises:
        InvalidValueError: See `read_history`.
        MiSplatError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    epochs = read_history(path)
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MiSplatError(message("plot", "the package matplotlib", "none", install("figures"))) from error
    figure = Figure(figsize=(9, 3.2), dpi=100, layout="constrained")
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
