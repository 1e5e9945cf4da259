"""The tables of the documentation follow from the raw rows, one for each look at each attack."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

from attacks.rendering_studies.config import read_rendering_study
from attacks.rendering_studies.jobs import attacks_of, looks_at
from attacks.rendering_studies.rates import image_psnr, outcomes
from attacks.rendering_studies.tables import KINDS, rate_table
from tests.project.layers import ROOT

TABLES = ROOT / "docs" / "tables"
STUDIES = sorted((ROOT / "scenes" / "studies").glob("*.toml"))
SEEN = ("clean", "attacked", "noise")


def rows() -> list[dict[str, str]]:
    with (TABLES / "rendering_studies.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def records(name: str) -> list[dict[str, Any]]:
    """The records of a study as its ledger had them, as far as tables need them."""
    found: dict[tuple[str, ...], dict[str, Any]] = {}
    for row in rows():
        if row["study"] != name:
            continue
        key = tuple(value for column, value in row.items() if column not in ("condition", *_columns()))
        config: dict[str, Any] = {"attributes": [row["attribute"]], "norm": row["norm"], "eps": [float(row["eps"])]}
        config["sh_degree"] = int(row["sh_degree"])
        job = {**{column: row[column] for column in ("detector", "renderer", "gradient")}, "config": config}
        record = found.setdefault(key, {"job": job, "attack": {"image_psnr": float(row["image_psnr"])}, "looks": {}})
        record["looks"][row["condition"]] = {
            kind: {f"{what}_score": float(row[f"{kind}_{what}"]) for what in ("original", "target")} for kind in SEEN
        }
    return list(found.values())


def _columns() -> tuple[str, ...]:
    return tuple(f"{kind}_{what}" for kind in SEEN for what in ("original", "target"))


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_every_rate_follows_from_the_rows(path: Path) -> None:
    study = read_rendering_study(path)
    found = records(study.name)
    assert len(found) == len(attacks_of(study))
    assert sum(len(one["looks"]) for one in found) == sum(len(looks_at(study, job)) for job in attacks_of(study))
    page = (TABLES / f"study_{study.name}.md").read_text().splitlines()
    counted = outcomes(found, confidence=study.confidence)
    for detector in study.detectors:
        own = [outcome for outcome in counted if outcome.group.detector == detector]
        for kind in KINDS:
            table = rate_table(own, kind)
            place = page.index(table[0], page.index(f"## {KINDS[kind]}: {detector}"))
            assert page[place : place + len(table)] == table
    for group, psnr in image_psnr(found).items():
        assert any(line.startswith(f"| {group.detector} | {group.source} | {group.ball} | {psnr:.1f}") for line in page)
