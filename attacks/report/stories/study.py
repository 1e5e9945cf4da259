"""What `mi-splat dagger-study` leaves behind: many attacks from one view each, against one detector."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.dagger.tables import TITLES, by_radius, rows
from attacks.rate import Rate
from attacks.report.section import Chart, Figure, Line, Point, Section, Table, doubts_of
from attacks.report.stories.ledger import ledger
from attacks.report.wording import counted, listed, number, percent, plural, sentence, shared

KIND = "DAGGER, a study"


def read(folder: Path, found: Mapping[str, Any]) -> Section:
    """The section of a study.

    Args:
        folder: Where it lies; jobs/ in it has every attack.
        found: Its table.json, which says no more than the jobs do.
    """
    records = ledger(folder / "jobs")
    table = rows(records)
    groups = list(dict.fromkeys(row["group"] for row in table))
    chosen = "pairs" if "pairs" in groups else groups[0]
    of_group = [row for row in table if row["group"] == chosen]
    rate, noise = _rate(of_group, "successes", "runs"), _rate(of_group, "noise_successes", "noise_draws")
    detectors = list(dict.fromkeys(record["result"]["detector"] for record in records))
    seeds = {record["job"]["config"]["seed"] for record in records}
    return Section(
        kind=KIND,
        title=f"{listed(detectors)}, {plural(len(records), 'attack')}",
        folder=str(folder),
        done=(
            f"{plural(len(records), 'attack')} on {listed(detectors)}, from one view each unless a table says "
            f"otherwise, with {plural(len(seeds), 'seed')}; every seed but 0 moves the camera. Each is judged on the "
            "saved file and an 8-bit picture, beside random noise of its size."
        ),
        conclusion=(
            f"{TITLES.get(chosen, chosen)}: {rate.successes} of {plural(rate.total, 'attack')} reach their aim, "
            f"random noise in {noise.successes} of {plural(noise.total, 'draw')}. This says nothing of other views "
            "or detectors."
        ),
        headline=Figure(
            label=f"attacks that reach their aim ({TITLES.get(chosen, chosen)})", rate=rate, note="all radii and seeds"
        ),
        control=Figure(label="random noise of the same size, draws with the same success", rate=noise)
        if noise.total
        else None,
        figures=tuple(_figures(table, groups)),
        warnings=tuple(map(sentence, [*doubts_of(rate, noise, what="attacks"), *_repeated(records)])),
        charts=tuple(_charts(records)),
        tables=tuple(_table(table, group) for group in groups),
        configuration=shared([{**record["job"], **_weights(record["result"])} for record in records]),
    )


def _weights(result: Mapping[str, Any]) -> dict[str, Any]:
    return {"detector": result["detector"], "weights": result["detector_fingerprint"]}


def _rate(table: Sequence[Mapping[str, Any]], successes: str, total: str) -> Rate:
    return Rate(successes=sum(row[successes] for row in table), total=sum(row[total] for row in table))


def _figures(table: Sequence[Mapping[str, Any]], groups: Sequence[str]) -> Iterator[Figure]:
    for group in groups:
        members = [row for row in table if row["group"] == group]
        yield Figure(label=TITLES.get(group, group), rate=_rate(members, "successes", "runs"), note="over all radii")


def _repeated(records: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The warnings of the attacks, each once."""
    found: dict[str, int] = {}
    for record in records:
        for text in record["result"]["warnings"]:
            found[text] = found.get(text, 0) + 1
    for text, count in found.items():
        yield f"{count} of {plural(len(records), 'attack')}: {text}"


def _charts(records: Sequence[Mapping[str, Any]]) -> Iterator[Chart]:
    lines = by_radius(records)
    kinds = dict.fromkeys((line["group"], line["attribute"], line["norm"]) for line in lines)
    for group, attribute, norm in kinds:
        members = [
            line for line in lines if (line["group"], line["attribute"], line["norm"]) == (group, attribute, norm)
        ]
        if len(members) < 2:
            continue
        noise = [(line["eps"], _rate([line], "noise_successes", "noise_draws")) for line in members]
        yield Chart(
            title=f"{TITLES.get(group, group)}: success over the radius",
            caption="Bands are 95 % intervals over all attacks with that radius.",
            x_label=f"eps ({norm} over {attribute})",
            y_label="attacks with success",
            lines=(
                Line(
                    name="attack",
                    role="attack",
                    points=tuple(Point.of(line["eps"], _rate([line], "successes", "runs")) for line in members),
                ),
                Line(
                    name="random noise",
                    role="control",
                    points=tuple(Point.of(eps, rate) for eps, rate in noise if rate.total),
                ),
            ),
            logarithmic=all(line["eps"] > 0 for line in members),
        )


def _table(table: Sequence[Mapping[str, Any]], group: str) -> Table:
    head = ("attack", "norm, eps", "success", "confidence", "class before, after", "steps", "PSNR", "noise", "warnings")
    cells = [
        (
            f"{row['object']} to {row['target'] or 'nothing'}",
            f"{row['norm']}, {row['eps']:g}",
            counted(_rate([row], "successes", "runs")),
            f"{percent(row['score'])} (least {percent(row['score_least'])})",
            percent(row["original_after"]),
            f"{row['steps']:g}",
            number(row["psnr"], unit="dB"),
            f"{row['noise_successes']} of {row['noise_draws']}",
            "; ".join(row["warnings"]) or "none",
        )
        for row in table
        if row["group"] == group
    ]
    return Table(caption=f"{TITLES.get(group, group)} (medians over the seeds)", head=head, rows=tuple(cells))
