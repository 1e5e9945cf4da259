"""Tables of a study of transfer: transfer.md for people, transfer.json for machines, transfer.png to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.dagger.tables import grid
from attacks.dagger.transfer.heat_map import draw_heat_maps
from attacks.dagger.transfer.jobs import SUCCESS
from attacks.dagger.transfer.matrix import (
    Cell,
    Record,
    attack_rows,
    attacked,
    cells,
    left_out,
    looked_rows,
    noise,
    title,
    weights,
)
from attacks.rate import Rate
from mi_splat import provenance
from mi_splat.io.documents import save_json, save_text


def markdown(records: Sequence[Record]) -> str:
    """The tables as one Markdown page."""
    matrix = cells(looked_rows(records))
    first = records[0]["attack"]
    config = first["config"]
    seeds = sorted({record["job"]["config"]["seed"] for record in records})
    lines = [
        "# Transfer of DAGGER",
        "",
        f"{len(records)} attacks: {config['norm']} ball of {config['eps'][0]:g} over the object's SH, "
        f"{config['steps']} steps, no early stop, one view, seeds {', '.join(map(str, seeds))}. A class counts from "
        f"{SUCCESS:g}, with every detector. Rates are of the runs whose clean object the judging detector finds; in "
        "brackets the 95 % Wilson "
        "interval. White box: the judging detector was attacked; marked with *.",
        "",
    ]
    lines += rate_tables(matrix)
    lines += [
        *left_out_table(matrix),
        "## The attacks",
        "",
        _attacks(records, attacked(matrix)),
        "",
    ]
    marks = "; ".join(f"{name} {', '.join(some)}" for name, some in weights(records).items())
    versions = ", ".join(f"{name} {version}" for name, version in first["versions"].items())
    lines += [f"Weights: {marks}.", ""]
    return "\n".join([*lines, f"Versions: {versions}; variant {first['variant']}; commit {first['commit']}.", ""])


def rate_tables(matrix: Sequence[Cell]) -> list[str]:
    """The lines of the two tables of rates."""
    names = list(dict.fromkeys(cell.detector for cell in matrix))
    lines = []
    for kind, what in (("targeted", "the wanted class is reported"), ("untargeted", "the object's class is gone")):
        lines += [f"## {kind.capitalize()}: {what}", "", _matrix(matrix, names, kind), ""]
    return lines


def _matrix(matrix: Sequence[Cell], names: Sequence[str], kind: str) -> str:
    by_place = {(cell.sources, cell.detector): cell for cell in matrix}
    body = []
    for sources in dict.fromkeys(cell.sources for cell in matrix):
        found = [by_place.get((sources, name)) for name in names]
        marks = ["-" if cell is None else f"{_rate(getattr(cell, kind))}{' *' * cell.white_box}" for cell in found]
        body.append([title(sources, attacked(matrix)), *marks])
    control = [_rate(noise(matrix, name, kind)) for name in names]
    return _page(["attacked, judged by", *names], [*body, ["random noise", *control]])


def left_out_table(matrix: Sequence[Cell]) -> list[str]:
    """The lines of the table of detectors that were left out of an attack on all others."""
    head = ["left out", "targeted: ensemble", "best single", "noise", "untargeted: ensemble", "best single", "noise"]
    body = []
    for row in left_out(matrix):
        words = [row["detector"]]
        for kind in ("targeted", "untargeted"):
            single = row[f"best_single_{kind}"]
            best = "-" if single is None else f"{_of(single[kind])} ({single['sources'][0]})"
            words += [_of(row["ensemble"][kind]), best, _of(row["ensemble"][f"noise_{kind}"])]
        body.append(words)
    return ["## Leave one out", "", _page(head, body) if body else "No ensembles were attacked.", ""]


def _attacks(records: Sequence[Record], every: Sequence[str]) -> str:
    body = [
        [
            title(row["sources"], every),
            _of(row["all_deceived"]),
            f"{row['steps']:g}",
            f"{row['image_psnr']:.1f}",
        ]
        for row in attack_rows(records)
    ]
    return _page(["attacked", "all of them deceived", "best step (median)", "PSNR, dB (median)"], body)


def _rate(rate: Rate) -> str:
    low, high = rate.interval
    return f"{rate.successes}/{rate.total} ({low:.2f} to {high:.2f})" if rate.total else "0/0"


def _of(rate: Mapping[str, Any]) -> str:
    return f"{rate['successes']}/{rate['total']}"


def _page(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    return "\n".join(grid(head, body))


def write_tables(records: Sequence[Record], out: Path) -> list[Path]:
    """Write transfer.md and transfer.json, and transfer.png where matplotlib is installed.

    Returns:
        The files written.
    """
    paths = [out / "transfer.md", out / "transfer.json"]
    matrix = cells(looked_rows(records))
    save_text(markdown(records), paths[0])
    document = {
        "cells": [cell.as_dict() for cell in matrix],
        "leave_one_out": left_out(matrix),
        "attacks": attack_rows(records),
        "weights": weights(records),
        **provenance.origin(),
    }
    save_json(document, paths[1])
    if draw_heat_maps(matrix, out / "transfer.png"):
        paths.append(out / "transfer.png")
    return paths


def write_held_out(
    records: Sequence[Record], out: Path, *, attacks: int, views: int, origin: Mapping[str, Any] | None = None
) -> list[Path]:
    """Write the matrix over held-out views: held_out.md, held_out.json and held_out.png (with matplotlib).

    Args:
        records: From `run_held_out`.
        out: Where to.
        attacks: Number of splats.
        views: Views of each.
        origin: What else the JSON shall hold, for instance the folder of the study.

    Returns:
        The files written.
    """
    paths, matrix = [out / "held_out.md", out / "held_out.json"], cells(looked_rows(records))
    said = (
        f"{attacks} splats that were attacked over a distribution of views, each looked at from {views} views that no "
        f"search has seen. A class counts from {SUCCESS:g}, with every detector. Rates are of the views in which the "
        "judging detector finds the clean object; in brackets the 95 % Wilson interval. White box: marked with *."
    )
    save_text("\n".join(["# Transfer over held-out views", "", said, "", *rate_tables(matrix)]), paths[0])
    save_json({"cells": [cell.as_dict() for cell in matrix], "views": views, **(origin or {})}, paths[1])
    if draw_heat_maps(matrix, out / "held_out.png"):
        paths.append(out / "held_out.png")
    return paths
