"""What `mi-splat dagger-pairs` leaves behind: the paper's six attacks on several detectors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.rate import Rate
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section, Table, doubts_of, shown
from attacks.report.wording import counted, listed, number, percent, plural, sentence, settings

KIND = "DAGGER, the six pairs"
MOST_PICTURES = 12

Row = Mapping[str, Any]


def read(folder: Path, found: Mapping[str, Any]) -> Section:
    """The section of the six pairs.

    Args:
        folder: Where it lies.
        found: Its summary.json.
    """
    rows = found["pairs"]
    rate, noise = _rate(rows), _noise(rows)
    names = list(dict.fromkeys(row["detector"] for row in rows))
    eps = sorted({row["eps"] for row in rows})
    return Section(
        kind=KIND,
        title=f"{listed(names)}, {found['search']} search",
        folder=str(folder),
        done=(
            f"{plural(len(rows), 'attack')} on {listed(names)}: the paper's six pairs, each from one view, within a "
            f"ball of {found['norm']} {listed([f'{one:g}' for one in eps])} over "
            f"{listed(found['attributes'])}, in at most {plural(found['steps_allowed'], 'step')}, with "
            f"{plural(len(found['seeds']), 'seed')}. Each is judged on the saved file and an 8-bit picture."
        ),
        conclusion=(
            f"{rate.successes} of {plural(rate.total, 'attack')} make the detector report the wanted class. Random "
            f"noise of the same size does so in {noise.successes} of {plural(noise.total, 'draw')}. This says nothing "
            "of other views, nor of detectors that were not attacked."
        ),
        headline=Figure(label="attacks after which the wanted class is reported", rate=rate),
        control=Figure(label="random noise of the same size, draws with the same success", rate=noise)
        if noise.total
        else None,
        figures=tuple(
            Figure(label=name, rate=_rate([row for row in rows if row["detector"] == name])) for name in names
        ),
        warnings=tuple(map(sentence, [*doubts_of(rate, noise, what="attacks"), *_doubts(rows)])),
        pictures=_pictures(folder, rows),
        charts=(_chart(rows, names),),
        tables=tuple(_tables(found)),
        configuration=settings(
            {key: value for key, value in found.items() if key not in ("pairs", "smallest", "command", "versions")}
        ),
    )


def _rate(rows: Sequence[Row]) -> Rate:
    return Rate(successes=sum(row["success"] for row in rows), total=len(rows))


def _noise(rows: Sequence[Row]) -> Rate:
    return Rate(successes=sum(row["control_success"] for row in rows), total=sum(row["control_draws"] for row in rows))


def _doubts(rows: Sequence[Row]) -> Iterator[str]:
    unclear = sum(row["success"] and not row["unambiguous"] for row in rows)
    if unclear:
        yield f"After {plural(unclear, 'attack')} with success another class has more confidence"
    unseen = sum(row["clean_confidence"] < 0.5 for row in rows)
    if unseen:
        yield f"In {unseen} of {plural(len(rows), 'attack')} the clean object is not found at 50 % or more"


def _pictures(folder: Path, rows: Sequence[Row]) -> tuple[Picture, ...]:
    there = [row for row in rows if row["seed"] == min(one["seed"] for one in rows)]
    return shown(
        [
            Picture(
                path=folder / row["picture"],
                caption=f"{row['detector']}: {row['object']} to {row['target']}, eps {row['eps']:g}; before and after.",
                alt=(
                    f"The picture before and after with boxes; {row['target']} is "
                    f"{'reported' if row['success'] else 'not reported'} at {percent(row['confidence'])}"
                ),
                wide=True,
            )
            for row in there
        ][:MOST_PICTURES]
    )


def _chart(rows: Sequence[Row], names: Sequence[str]) -> Chart:
    lines = []
    for role, name, count in (("attack", "attack", _rate), ("control", "random noise", _noise)):
        rates = [count([row for row in rows if row["detector"] == one]) for one in names]
        points = tuple(Point.of(place, rate) for place, rate in enumerate(rates) if rate.total)
        lines.append(Line(name=name, role="attack" if role == "attack" else "control", points=points))
    return Chart(
        title="Success, by detector",
        caption="Over all pairs, radii and seeds; bars are 95 % intervals.",
        x_label="detector",
        y_label="attacks with success",
        lines=tuple(lines),
        ticks=tuple(names),
        connected=False,
    )


def _tables(found: Mapping[str, Any]) -> Iterator[Table]:
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in found["pairs"]:
        groups.setdefault(tuple(row[key] for key in ("detector", "object", "target", "eps")), []).append(row)
    head = ("attack", "detector", "eps", "success", "confidence", "steps", "PSNR", "noise")
    cells = [
        (
            f"{thing} to {target}",
            detector,
            f"{eps:g}",
            counted(_rate(rows)),
            _span([percent(row["confidence"]) for row in sorted(rows, key=lambda row: row["confidence"])]),
            _span([str(steps) for steps in sorted(row["steps"] for row in rows)]),
            _span(
                [number(psnr) for psnr in sorted(row["image_psnr"] for row in rows if row["image_psnr"] is not None)]
            ),
            f"{_noise(rows).successes} of {_noise(rows).total}",
        )
        for (detector, thing, target, eps), rows in groups.items()
    ]
    yield Table(caption="Every pair, over its seeds", head=head, rows=tuple(cells))
    if found["smallest"]:
        rows = tuple(
            (f"{row['object']} to {row['target']}", row["detector"], *(number(eps, "g") for eps in row["eps"]))
            for row in found["smallest"]
        )
        seeds = tuple(f"seed {seed}" for seed in found["seeds"])
        yield Table(caption="Smallest radius that suffices", head=("attack", "detector", *seeds), rows=rows)


def _span(words: Sequence[str]) -> str:
    """First to last of some words in their order."""
    if not words:
        return "-"
    return words[0] if words[0] == words[-1] else f"{words[0]} to {words[-1]}"
