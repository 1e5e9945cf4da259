"""`python -m attacks.detectors.training.curves`: the picture of a training run in the model card."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import tyro

_HERE = Path(__file__).parents[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing:
    """Draw losses and validation mAP by epoch; needs matplotlib.

    Attributes:
        curves: JSON file with the history of a run.
        out: Picture to write.
    """

    curves: Path = _HERE / "fasterrcnn_small.json"
    out: Path = _HERE / "fasterrcnn_small.png"


def main(drawing: Drawing) -> None:
    """Draw one picture."""
    from matplotlib.figure import Figure

    epochs = [record for record in json.loads(drawing.curves.read_text())["history"] if record["epoch"] > 0]
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
    figure.savefig(drawing.out)


if __name__ == "__main__":
    main(tyro.cli(Drawing))
