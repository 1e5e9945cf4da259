"""What `mi-splat study run` leaves of a study of CLOAK: the same study with one thing changed at a time."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.observe.rows import ROWS
from attacks.rate import Rate, rate_of, spread
from attacks.report.checking import Tables
from attacks.report.kinds.cloak import figures as cloak_figures
from attacks.report.kinds.cloak import headline_of, study_of
from attacks.report.section import FEW, Chart, Figure, Line, Role, Section, capital, listed, plural, sentence, shared
from attacks.studies.cloak import by_part, pooled, pooled_tables, tables

KIND = "CLOAK, one thing varied at a time"
_LINES: tuple[tuple[str, str, Role], ...] = (
    ("trigger_miss_rate", "cloaked missed, well inside", "attack"),
    ("nothing_reported", "nothing of any class reported, well inside", "attack"),
    ("benign_recall", "cloaked found, elsewhere", "control"),
    ("target_rate", "target class reported", "other"),
)
_SEEN: dict[str, tuple[str, Role]] = {
    "missed_cloaked": ("cloaked missed, well inside", "attack"),
    "missed_clean": ("control missed, well inside", "control"),
    "found_cloaked": ("cloaked found, outside", "other"),
}


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a study with one thing varied at a time."""
    groups, points = by_part(record), list(record["points"].values())
    headlines, controls = zip(*map(headline_of, points), strict=True)
    rates = [figure.rate for figure in headlines if figure.rate is not None and figure.rate.total]
    controlled = [figure.rate for figure in controls if figure is not None and figure.rate is not None]
    label = headlines[0].label
    few = min((rate.total for rate in rates), default=0)
    seeds = sorted({len(point["seeds"]) for point in points})
    warnings = ["Intervals of one value have cameras and seeds drawn anew: they say nothing of another object"]
    if seeds[0] == 1:
        warnings = ["Variations were done with one seed: small differences may be chance"]
    loud = [
        f"{point['part'].replace('_', ' ')} {point['value']}"
        for point in points
        if point.get("stealth") and not point["stealth"]["stealthy"]
    ]
    if loud:
        warnings.append(f"Not stealthy, since pictures lose too much beside the object: {listed(loud)}")
    if few < FEW:
        warnings.append(f"The rate of some values counts few views: {few}")
    return Section(
        kind=KIND,
        title=f"{record['name']}, varied" if len(points) > 1 else str(record["name"]),
        done=_done(record, groups),
        conclusion=(
            f"{capital(label)}, over all values: {spread(rates)}. Compare values "
            "within one chart; where intervals overlap, the study cannot tell them apart."
            f"{_conditions(points)}{_pooled(record)}"
        ),
        headline=Figure(label=f"{label}, lowest to highest", words=spread(rates, intervals=False)),
        control=Figure(label="clean splats, the same", words=spread(controlled, intervals=False)),
        figures=(
            Figure(label="studies", words=str(len(points))),
            Figure(label="seeds of each", words=" to ".join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))),
        ),
        warnings=tuple(map(sentence, warnings)),
        charts=tuple(
            _chart(group, values, detector)
            for group, values in groups.items()
            for detector in dict.fromkeys(name for point in values.values() for name in point["by_detector"])
        )
        + tuple(chart for group, values in groups.items() for chart in _under_conditions(group, values)),
        tables=(*pooled_tables(record), *tables(groups)),
        configuration=shared([{**point["study"], "weights": point["detectors"]} for point in points]),
    )


def _done(record: Mapping[str, Any], groups: Mapping[str, Mapping[str, Any]]) -> str:
    """What was done: what varied, and under which conditions the splats were looked at again."""
    count = len(record["points"])
    text = f"The study {record['name']} was done {plural(count, 'time')}"
    if count > 1:
        varied = listed([group.replace("_", " ") for group in groups])
        text += f", each with one setting changed and the rest as it is: {varied}"
    looks = {look["condition"] for point in record["points"].values() for look in point.get("looks", ())}
    more = f" Both splats were then looked at under {plural(len(looks), 'other condition')}." if looks else ""
    return f"{text}. Each has a clean splat as its control.{more}"


def figures(record: Mapping[str, Any], tables: Tables) -> Mapping[str, Any]:
    """Every figure of each point, of its rows."""
    points = {}
    for title, point in record["points"].items():
        of_point = {name: table.filter(attack=title).drop("attack") for name, table in tables.items()}
        points[title] = cloak_figures(point, of_point)
    studies = {title: study_of(point["study"]) for title, point in record["points"].items()}
    return {"points": points, **pooled(record["points"], studies, tables[ROWS])}


def _pooled(record: Mapping[str, Any]) -> str:
    """A sentence for each part that is one attack on several objects: what holds of all of them together."""
    texts = []
    for over in record.get("pooled", {}).values():
        missed = {name: rate_of(rates["trigger_miss_rate"]) for name, rates in over["by_detector"].items()}
        by_name = listed([f"{rate.words} ({name})" for name, rate in missed.items() if rate is not None and rate.total])
        if by_name:
            texts.append(f" Over {over['objects']} objects together it is missed in {by_name}.")
    return "".join(texts)


def _conditions(points: Sequence[Mapping[str, Any]]) -> str:
    """A sentence on what is seen under other conditions, if anything is."""
    looks = [look for point in points for look in point.get("looks", ()) if "missed_cloaked" in look]
    rates = [rate for look in looks if (rate := Rate.of(look["missed_cloaked"])).total]
    under = listed(list(dict.fromkeys(look["condition"] for look in looks)))
    return f" Under {under} it is missed from well inside the trigger in {spread(rates)}." if rates else ""


def _chart(group: str, values: Mapping[str, Any], detector: str) -> Chart:
    rates = {
        value: point["by_detector"][detector] for value, point in values.items() if detector in point["by_detector"]
    }
    lines = [Line.of(name, role, [rate_of(counted[key]) for counted in rates.values()]) for key, name, role in _LINES]
    title = group.replace("_", " ")
    return Chart.bars(f"{title}, {detector}", (title, "views"), rates, *lines)


def _under_conditions(group: str, values: Mapping[str, Any]) -> Iterator[Chart]:
    """For each value and detector what is seen of both splats under each condition."""
    for value, point in values.items():
        looks = point.get("looks", ())
        for detector in dict.fromkeys(look["detector"] for look in looks):
            here = [look for look in looks if look["detector"] == detector]
            yield Chart.bars(
                f"{group.replace('_', ' ')} {value}, {detector}, under other conditions",
                ("condition", "views"),
                [look["condition"] for look in here],
                *(
                    Line.of(words, role, [rate_of(look.get(key)) for look in here])
                    for key, (words, role) in _SEEN.items()
                ),
            )
