"""The files of docs/tables of the rendering studies, counted from rows
(`result_tables`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl

    from attacks.figures.frame import Figure

ROWS = "rendering_studies.csv.xz"
_MADE = (
    "python 3.11.7, mi-splat 0.1.0, mitsuba 3.9.1, drjit 1.5.0, torch 2.15.0,"
    " torchvision 0.29.2, numpy 2.4.6"
)
_OURS = "fasterrcnn_small 7da0801b51b03b75"
STUDIES: dict[str, tuple[str, float, str, str]] = {
    "between_renderers": (
        "between renderers",
        0.5,
        _OURS,
        "ef92504c1126274fe7d2e60e6cf310ab777727b8",
    ),
    "gradients": (
        "by whose gradients",
        0.5,
        _OURS,
        "58c7529b0230507c39d23dd7e22b72a81f3dcc43+changes",
    ),
    "files": (
        "after other files",
        0.5,
        _OURS,
        "ef92504c1126274fe7d2e60e6cf310ab777727b8",
    ),
    "sun": (
        "under the sun",
        0.3,
        "centernet_coco 095e4df75766ddc7; nanodet_coco 646ac96e7c3021ab",
        "58c7529b0230507c39d23dd7e22b72a81f3dcc43+changes",
    ),
}
"""For each study the end of its title, the confidence from which a class counts,
weights, and commit.
"""
KINDS = {
    "targeted": "The wanted class is reported",
    "untargeted": "The object's class is no longer reported",
}


def page(name: str, tables: Path) -> str:
    """A page as Markdown.

    Args:
        name: One of `STUDIES`.
        tables: The folder docs/tables.
    """
    import polars as pl

    from attacks.observe.rows import read_rows

    title, confidence, weights, commit = STUDIES[name]
    parts = pl.col("attack").str.split("; ")
    rows = read_rows(tables / ROWS).with_columns(
        study=parts.list.get(0),
        pair=parts.list.get(1),
        source=parts.list.get(2),
        ball=parts.list.get(3),
    )
    rows = rows.filter(study=name)
    attacks = rows.select("attack", "seed", "detector").unique().height
    pairs = "; ".join(_values(rows, "pair"))
    seeds = ", ".join(map(str, _values(rows, "seed")))
    head = [
        f"# DAGGER {title}: tables",
        (
            f"Of `scenes/studies/{name}.toml`; what follows from them is in [rendering"
            " studies](../rendering-studies.md)."
        ),
        (
            f"{attacks} attacks: {pairs}; seeds {seeds}; no early stop. The detector"
            " that was attacked evaluates 8-bit images of the saved splat; a class"
            f" counts from {confidence}. Rates are of the runs whose clean object is"
            " found under the same condition; in brackets the 95 % Wilson interval."
        ),
    ]
    foot = [
        f"Weights: {weights}.",
        f"Versions: {_MADE}, pillow 13.0.0; llvm_ad_rgb; commit {commit}.",
    ]
    return "\n\n".join([*head, *_rates(rows, confidence), _visible(rows), *foot]) + "\n"


def _values(rows: pl.DataFrame, column: str) -> list[str]:
    return [str(value) for value in rows[column].unique(maintain_order=True)]


def _rates(rows: pl.DataFrame, confidence: float) -> Iterator[str]:
    """A table for each detector and kind: conditions downwards, attacks across."""
    from attacks.figures.rate import pooled
    from attacks.observe.rates import count, transfer_measures, with_control

    by = ("detector", "source", "ball", "condition")
    counted = count(with_control(rows), transfer_measures(confidence), by)
    for (detector,), of_detector in counted.groups("detector").items():
        attacks = of_detector.groups("source", "ball")
        for kind, words in KINDS.items():
            body = []
            for condition in _values(rows, "condition"):
                seen = [of.where(condition=condition) for of in attacks.values()]
                cells = [_rate_text(of.find(kind)) for of in seen]
                noise = pooled(of.rate(f"noise_{kind}") for of in seen)
                body.append([condition, *cells, noise.short()])
            names = [f"{source}: {ball}" for source, ball in attacks]
            table = _table(["evaluated under", *names, "random noise"], body)
            yield f"## {words}: {detector}\n\n{table}"


def _rate_text(rate: Figure | None) -> str:
    from attacks.figures.rate import Rate

    return rate.short(interval=True) if isinstance(rate, Rate) else "-"


def _visible(rows: pl.DataFrame) -> str:
    """PSNR of the attacked pictures."""
    import polars as pl

    groups = rows.group_by("detector", "source", "ball", maintain_order=True).agg(
        pl.col("psnr").median()
    )
    body = [[*map(str, group[:3]), f"{group[3]:.1f}"] for group in groups.rows()]
    table = _table(["detector", "attacked in", "ball", "PSNR, dB (median)"], body)
    return f"## How visible the attacks are\n\n{table}"


def _table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    return "\n".join(
        f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *body)
    )
