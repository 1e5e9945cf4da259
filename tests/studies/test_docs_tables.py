"""The tables of the rendering studies in the documentation follow from their rows, one for each look at each attack."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import polars as pl
import pytest

from attacks.observe.measures import transfer_measures, with_control
from attacks.observe.rates import count
from attacks.observe.rows import read_rows
from attacks.rate import Rate
from tests.project.layers import ROOT

TABLES = ROOT / "docs" / "tables"
PAGES = sorted(TABLES.glob("study_*.md"))
KINDS = {
    "The wanted class is reported": "targeted",
    "The object's class is no longer reported": "untargeted",
}
VISIBLE = "How visible the attacks are"


def rows_of(study: str) -> pl.DataFrame:
    """The rows of a study, with the two parts of the attack's name that its tables group by."""
    rows = read_rows(TABLES / "rendering_studies.csv.gz")
    parts = pl.col("attack").str.split("; ")
    rows = rows.with_columns(study=parts.list.get(0), source=parts.list.get(2), ball=parts.list.get(3))
    return rows.filter(study=study)


def tables(page: Path) -> Iterator[tuple[str, list[list[str]]]]:
    """Title and cells of every table of a page."""
    for section in page.read_text().split("\n## ")[1:]:
        lines = [line for line in section.splitlines() if line.startswith("|")]
        yield section.splitlines()[0], [line.strip("| ").split(" | ") for line in lines if "---" not in line]


def said(rate: Rate) -> str:
    low, high = rate.interval
    return f"{rate.successes}/{rate.total} ({low:.2f} to {high:.2f})" if rate.total else "0/0"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_every_rate_follows_from_the_rows(page: Path) -> None:
    rows = rows_of(page.stem.removeprefix("study_"))
    (confidence,) = re.findall(r"a class counts from ([0-9.]*[0-9])\.", page.read_text())
    table = with_control(rows)
    by = ("detector", "source", "ball", "condition")
    counted = count(table, transfer_measures(float(confidence)), by)
    checked = 0
    for title, (head, *body) in tables(page):
        if title == VISIBLE:
            medians = rows.group_by("detector", "source", "ball").agg(pl.col("psnr").median())
            psnr = {tuple(group): f"{value:.1f}" for *group, value in medians.iter_rows()}
            assert {tuple(line[:3]): line[3] for line in body} == psnr
            continue
        what, detector = title.split(": ")
        kind = KINDS[what]
        for condition, *cells, noise in body:
            drawn = []
            for column, cell in zip(head[1:-1], cells, strict=True):
                source, ball = column.split(": ")
                found = counted.get((detector, source, ball, condition))
                assert cell == ("-" if found is None else said(found[kind])), (title, condition, column)
                drawn += [] if found is None else [found[f"noise_{kind}"]]
                checked += 1
            total = f"{sum(rate.successes for rate in drawn)}/{sum(rate.total for rate in drawn)}"
            assert noise == total
    assert checked >= 2 * len(counted)
