"""What `mi-splat dagger-eot-study` leaves behind: many attacks on all cameras of a region."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.dagger.eot.tables import TITLES, row, smallest_radii
from attacks.rate import Rate
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section, Table, doubts_of, shown
from attacks.report.stories.ledger import ledger
from attacks.report.wording import capital, counted, listed, number, percent, plural, sentence, shared

KIND = "DAGGER from all cameras, a study"
MOST_PICTURES = 3
_CURVES = {"psnr": ("psnr", "PSNR of the held-out pictures, dB"), "curve": ("eps", "radius")}
"""Groups that are curves: what they go over, and what that is called."""

Row = Mapping[str, Any]


def read(folder: Path, found: Mapping[str, Any]) -> Section:
    """The section of a study.

    Args:
        folder: Where it lies; jobs/ in it has every attack.
        found: Its table.json, which says no more than the jobs do.
    """
    records = ledger(folder / "jobs")
    rows = [row(record) for record in records]
    groups = list(dict.fromkeys(one["group"] for one in rows))
    names = list(dict.fromkeys(listed(one["detectors"]) for one in rows))
    needed = records[0]["result"]["config"]["required_views"]
    headline, control, what = _headline(rows, needed)
    rate, noise = headline.rate or _rate(rows), control.rate or _noise(rows)
    return Section(
        kind=KIND,
        title=f"{'; '.join(names)}, {plural(len(records), 'attack')}",
        folder=str(folder),
        done=(
            f"{plural(len(records), 'attack')} on {'; '.join(names)}, each from random cameras of a region, and each "
            "judged from the saved file, in 8-bit pictures of held-out views that no search has seen, beside random "
            f"noise of its size. An attack succeeds in {percent(needed)} of its views."
        ),
        conclusion=(
            f"{capital(headline.label)}: {headline.counts}; {control.label}: {control.counts}. "
            f"{'' if what == 'attacks' else _held(rows)}Views of one attack are not independent. "
            "This says nothing of detectors that were not attacked."
        ),
        headline=headline,
        control=control if noise.total else None,
        figures=(Figure(label="held-out views of all attacks, with success", rate=_rate(rows)),),
        warnings=tuple(map(sentence, [*doubts_of(rate, noise, what=what), *_warnings(rows)])),
        pictures=_pictures(folder, records),
        charts=(*(_each(rows, group) for group in groups if group not in _CURVES), *_curves(rows)),
        tables=(*(_table(rows, group) for group in groups), *_smallest(records)),
        configuration=shared(
            [
                {
                    **record["job"],
                    "weights": {
                        entry["detector"]: entry["detector_fingerprint"] for entry in record["result"]["detectors"]
                    },
                }
                for record in records
            ]
        ),
    )


def _headline(rows: Sequence[Row], needed: float) -> tuple[Figure, Figure, str]:
    """The figure that matters, its control, and what they count: views of the pairs, or attacks where settings vary."""
    members = [one for one in rows if one["group"] == "pairs"]
    if members:
        attack = Figure(label="held-out views of the paper's pairs with success", rate=_rate(members))
        noise = Figure(label="random noise of the same size, on the same views", rate=_noise(members))
        return attack, noise, "held-out views"
    judged = [one for one in rows if one["noise_views"]]
    enough = sum(one["noise_successes"] >= needed * one["noise_views"] for one in judged)
    reached = Rate(successes=sum(one["success"] for one in rows), total=len(rows))
    attack = Figure(label="attacks that hold in enough held-out views", rate=reached, note="settings vary")
    noise = Figure(label="random noise of their sizes that does", rate=Rate(successes=enough, total=len(judged)))
    return attack, noise, "attacks"


def _rate(rows: Sequence[Row]) -> Rate:
    return Rate(successes=sum(one["successes"] for one in rows), total=sum(one["views"] for one in rows))


def _noise(rows: Sequence[Row]) -> Rate:
    return Rate(successes=sum(one["noise_successes"] for one in rows), total=sum(one["noise_views"] for one in rows))


def _held(rows: Sequence[Row]) -> str:
    return f"{sum(one['success'] for one in rows)} of {plural(len(rows), 'attack')} hold in enough views. "


def _called(one: Row) -> str:
    return f"{one['object']} to {one['target'] or 'nothing'}"


def _warnings(rows: Sequence[Row]) -> Iterator[str]:
    for one in rows:
        for text in one["warnings"]:
            yield f"{TITLES.get(one['group'], one['group'])}, {_called(one)}: {text}"


def _pictures(folder: Path, records: Sequence[Mapping[str, Any]]) -> tuple[Picture, ...]:
    found = []
    for path in sorted((folder / "results").glob("*/held_out.png")):
        found.append(
            Picture(
                path=path,
                caption=f"{path.parent.name}: clean on the left of each pair, attacked on the right.",
                alt="Held-out views in pairs with boxes, clean and attacked",
                wide=True,
            )
        )
    return shown(found[:MOST_PICTURES] if records else [])


def _each(every: Sequence[Row], group: str) -> Chart:
    rows = [one for one in every if one["group"] == group]
    lines: tuple[tuple[str, str, Any], ...] = (("attack", "attack", _rate), ("control", "random noise", _noise))
    return Chart(
        title=TITLES.get(group, group),
        caption="Held-out views of each attack, in the order of its table; bars are 95 % intervals.",
        x_label="attack, by its number in the table",
        y_label="views with success",
        lines=tuple(
            Line(
                name=name,
                role="attack" if role == "attack" else "control",
                points=tuple(Point.of(place, count([one])) for place, one in enumerate(rows) if count([one]).total),
            )
            for role, name, count in lines
        ),
        ticks=tuple(map(str, range(1, len(rows) + 1))),
        connected=False,
    )


def _curves(rows: Sequence[Row]) -> Iterator[Chart]:
    for group, (key, label) in _CURVES.items():
        members = [one for one in rows if one["group"] == group and one[key] is not None]
        names = list(dict.fromkeys(listed(one["detectors"]) for one in members))
        if len(members) < 2:
            continue
        yield Chart(
            title=TITLES[group],
            caption="Held-out views; bands are 95 % intervals.",
            x_label=label,
            y_label="views with success",
            lines=tuple(
                Line(
                    name=name,
                    role="attack",
                    points=tuple(
                        Point.of(one["eps"][0] if key == "eps" else one[key], _rate([one]))
                        for one in members
                        if listed(one["detectors"]) == name
                    ),
                )
                for name in names[:6]
            ),
        )


def _table(rows: Sequence[Row], group: str) -> Table:
    head = ("attack", "detectors", "what may change", "held-out views", "noise", "no attack", "PSNR", "steps", "seed")
    cells = []
    for one in rows:
        if one["group"] == group:
            radii = one["eps"] if len(one["eps"]) > 1 else one["eps"] * len(one["attributes"])
            change = ", ".join(f"{name} {eps:g}" for name, eps in zip(one["attributes"], radii, strict=True))
            cells.append(
                (
                    _called(one),
                    listed(one["detectors"]),
                    f"{one['norm']}: {change}",
                    counted(_rate([one])) + ("" if one["success"] else " (not enough)"),
                    f"{one['noise_successes']} of {one['noise_views']}",
                    f"{one['clean_successes']} of {one['views']}",
                    number(one["psnr"], unit="dB"),
                    f"{one['steps']} of {one['all_steps']}",
                    str(one["seed"]),
                )
            )
    return Table(caption=TITLES.get(group, group), head=head, rows=tuple(cells))


def _smallest(records: Sequence[Mapping[str, Any]]) -> Iterator[Table]:
    lines = smallest_radii(records)
    if lines:
        cells = tuple(
            (_called(line), listed(line["detectors"]), number(line["smallest"], "g"), number(line["not_enough"], "g"))
            for line in lines
        )
        head = ("attack", "detectors", "radius", "largest that was not enough")
        yield Table(caption="Smallest radius that was enough", head=head, rows=cells)
