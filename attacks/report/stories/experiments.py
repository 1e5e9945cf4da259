"""What `mi-splat cloak-experiment` leaves behind: a study's splats seen again, or shown perfectly."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from attacks.cloak.rates import RATES
from attacks.cloak.study_toml import study_toml
from attacks.rate import Rate, percent
from attacks.report.section import Chart, Figure, Line, Point, Role, Section
from attacks.report.wording import listed, number, plural, pooled, rate_of, settings
from attacks.tables import Table, cell

Document = Mapping[str, Any]
Row = Mapping[str, Any]

_HIDES, _NOTHING, _SHOWS = "trigger_miss_rate", "nothing_reported", "target_rate"
PLACES = {"overhead": "well inside the trigger", "elsewhere": "outside of all triggers"}


def of_study(read: Callable[[Path, Document], Section]) -> Callable[[Path, Document], Section]:
    """A reader of an experiment, with what all of them have: the study, its settings and its file."""

    def read_whole(path: Path, document: Document) -> Section:
        study, name = document["configuration"], str(document["study"])
        weights = {"weights": document["detectors"]} if document.get("detectors") else {}
        return replace(
            read(path, document),
            title=name,
            configuration=settings({**document["settings"], **study, **weights}),
            file=(f"{name}.toml", study_toml(study)),
        )

    return read_whole


def matching(rows: Sequence[Row], **wanted: object) -> list[Row]:
    """The rows that have all of the wanted values."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """An experiment that looks at splats of a study under several conditions.

    Attributes:
        key: Of a row, what names the condition.
        kind: Of the section.
        done: What was done; {names} are the detectors, {conditions} the conditions, {count} their number.
        conclusion: {range} are the lowest and the highest rate well inside the trigger, {first} is the condition of the
            headline and {counts} its rate.
        first: The condition of the headline; None is the first of the rows.
        control: The splat and the cameras of the control.
        over: Whether conditions are numbers, so that a chart goes over them.
        drawn: Whether there are charts.
        head: What the conditions are called in tables.
    """

    key: str
    kind: str
    done: str
    conclusion: str
    first: Any = None
    control: tuple[str, str] = ("clean", "overhead")
    over: str = ""
    drawn: bool = False
    head: str


EXPERIMENTS = {
    "distance": Conditions(
        key="distance",
        head="times the distance",
        kind="CLOAK from other distances",
        done=(
            "{names} looked at the clean and at the cloaked splat from held-out cameras that were moved to {ends} "
            "times the distance of the training pictures."
        ),
        conclusion=(
            "From the study's own distance the cloaked object is missed in {counts} views well inside the trigger, the "
            "clean one in {control}. The curves say how this changes with the distance."
        ),
        first=1.0,
        over="distance, of the study's",
        drawn=True,
    ),
    "formats": Conditions(
        key="form",
        head="form",
        kind="CLOAK in other file formats",
        done=(
            "The cloaked splat went through {count} forms: file formats, half precision, and fewer SH bands. {names} "
            "then looked at each from held-out cameras."
        ),
        conclusion=(
            "Over all forms the object is missed in {range} of the views well inside the trigger ({first}: {counts}). "
            "A form in which it is found there undoes the attack."
        ),
        first=".ply",
        control=("cloaked", "elsewhere"),
        drawn=True,
    ),
    "renderers": Conditions(
        key="renderer",
        head="renderer",
        kind="CLOAK in other renderers",
        done="{names} looked at pictures of the clean and of the cloaked splat by {conditions}.",
        conclusion=(
            "Over all renderers the cloaked object is missed in {range} of the views well inside the trigger ({first}, "
            "which it was trained with: {counts})."
        ),
    ),
    "street": Conditions(
        key="hour",
        head="hour",
        kind="CLOAK on a street of meshes",
        done=(
            "The object of the clean and of the cloaked splat was put on a path-traced street of meshes. {names} "
            "looked at pictures of it under the sun of {conditions}."
        ),
        conclusion=(
            "Over all hours the cloaked object is missed in {range} of the views well inside the trigger ({first}: "
            "{counts})."
        ),
    ),
}
"""By name; rows have the splat (cloaked where there is one alone), the cameras, the detector, and what was found."""


def read_conditions(path: Path, document: Document) -> Section:
    """The section of an experiment of `EXPERIMENTS`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    how = EXPERIMENTS[document["experiment"]]
    rows: Sequence[Row] = [{"splat": "cloaked", **row} for row in document["found"]]
    names, conditions = (list(dict.fromkeys(row[by] for row in rows)) for by in ("detector", how.key))

    def missed(condition: object, splat: str = "cloaked", cameras: str = "overhead") -> Rate:
        return pooled(map(_missed, matching(rows, **{how.key: condition}, splat=splat, cameras=cameras)))

    first = how.first if how.first in conditions else conditions[0]
    rate, control = missed(first), missed(first, *how.control)
    fractions = [missed(condition).fraction for condition in conditions]
    words = {
        "names": listed(names),
        "conditions": listed(list(map(_named, conditions))),
        "count": len(conditions),
        "ends": f"{_named(min(conditions))} to {_named(max(conditions))}" if how.over else "",
        "range": f"{percent(min(fractions))} to {percent(max(fractions))}",
        "first": _named(first),
        "counts": rate.counts,
        "control": control.counts,
    }
    splat, cameras = how.control
    return Section(
        kind=how.kind,
        title="",
        done=how.done.format(**words),
        conclusion=how.conclusion.format(**words),
        headline=Figure(label=f"{_named(first)}, cloaked splat: object missed {PLACES['overhead']}", rate=rate),
        control=Figure(label=f"{_named(first)}, {splat} splat: object missed {PLACES[cameras]}", rate=control)
        if control.total
        else None,
        figures=tuple(
            Figure(
                label=f"{_named(one)}, {splat} splat: object missed {PLACES[cameras]}", rate=missed(one, splat, cameras)
            )
            for one in conditions
            for splat, cameras in (("cloaked", "overhead"), ("clean", "overhead"), ("cloaked", "elsewhere"))
            if missed(one, splat, cameras).total and (one != first or cameras == "elsewhere")
        ),
        warnings=(*(["The rates at the top pool all detectors: look at each"] if len(names) > 1 else []),),
        charts=tuple(_chart(how, rows, conditions, name) for name in names if how.drawn),
        tables=tuple(_table(how, rows, name) for name in names),
    )


def _named(condition: object) -> str:
    return f"{condition:g}" if isinstance(condition, float) else str(condition)


def _found(row: Row) -> Rate:
    rate = Rate(successes=int(row["found"]), total=int(row["of"]))
    if not 0 <= rate.successes <= rate.total:
        raise ValueError(f"a rate of {rate.successes} of {rate.total}")
    return rate


def _missed(row: Row) -> Rate:
    rate = _found(row)
    return Rate(successes=rate.total - rate.successes, total=rate.total)


def _chart(how: Conditions, rows: Sequence[Row], conditions: Sequence[Any], name: str) -> Chart:
    """How often a detector finds the object under each condition."""
    kinds: tuple[tuple[str, str, Role], ...] = (
        ("cloaked", "overhead", "attack"),
        ("clean", "overhead", "control"),
        ("cloaked", "elsewhere", "other" if how.over else "control"),
    )
    lines = []
    for splat, cameras, role in kinds:
        own = matching(rows, detector=name, splat=splat, cameras=cameras)
        at = [(row[how.key] if how.over else conditions.index(row[how.key]), row) for row in own if row["of"]]
        points = tuple(Point.of(float(place), _found(row)) for place, row in at)
        lines.append(Line(name=f"{splat}, {PLACES[cameras]}", role=role, points=points))
    return Chart(
        title=f"Found by {name}, by {how.key}",
        caption="Intervals are 95 %. The attack works where the object is not found well inside the trigger.",
        x_label=how.over or how.head,
        y_label="views in which it is found",
        lines=tuple(lines),
        ticks=() if how.over else tuple(conditions),
        connected=bool(how.over),
    )


def _table(how: Conditions, rows: Sequence[Row], name: str) -> Table:
    """A row for each condition, a column for each splat and group of cameras."""
    own = matching(rows, detector=name)
    groups = list(dict.fromkeys((row["splat"], row["cameras"]) for row in own))
    has_psnr = "psnr" in own[0]
    cells = []
    for condition in dict.fromkeys(row[how.key] for row in own):
        here = {(row["splat"], row["cameras"]): row for row in own if row[how.key] == condition}
        psnr = [number(here[group]["psnr"], unit="dB") for group in groups] if has_psnr else []
        cells.append((_named(condition), *(cell(_found(here[group])) for group in groups), *psnr))
    heads = [f"{splat}, {PLACES.get(cameras, cameras)}" for splat, cameras in groups]
    more = [f"PSNR, {splat}, {PLACES.get(cameras, cameras)}" for splat, cameras in groups] if has_psnr else []
    return Table(caption=f"Found by {name}", head=(how.head, *heads, *more), rows=tuple(cells))


def read_surroundings(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment surroundings`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    rows: Sequence[Row] = document["found"]
    inside, elsewhere = rows[0], rows[-1]
    loss = None
    if inside["psnr_mean"] is not None and elsewhere["psnr_mean"] is not None:
        loss = elsewhere["psnr_mean"] - inside["psnr_mean"]
    return Section(
        title="",
        kind="CLOAK beside the object",
        done=(
            "The cloaked splat's pictures were compared with the clean splat's, outside of the object, from held-out "
            "cameras inside the hiding trigger and elsewhere."
        ),
        conclusion=(
            f"Beside the object both splats show the same to {number(inside['psnr_mean'], unit='dB')} inside the "
            f"trigger and to {number(elsewhere['psnr_mean'], unit='dB')} elsewhere"
            f"{'' if loss is None else f', a difference of {loss:.1f} dB'}. Who stands in the trigger sees the former."
        ),
        headline=Figure(
            label="inside the trigger: PSNR beside the object", words=number(inside["psnr_mean"], unit="dB")
        ),
        control=Figure(label="elsewhere: PSNR beside the object", words=number(elsewhere["psnr_mean"], unit="dB")),
        warnings=[
            *(f"No camera {row['cameras']}: nothing was compared there" for row in rows if not row["of"]),
            *(f"Few pictures {row['cameras']}: {row['of']}" for row in rows if 0 < row["of"] < 10),
        ],
        tables=[
            Table(
                caption="PSNR of the cloaked splat against the clean one, outside of the object",
                head=("cameras", "pictures", "mean", "lowest", "highest"),
                rows=tuple(
                    (
                        row["cameras"],
                        str(row["of"]),
                        *(number(row[f"psnr_{which}"], unit="dB") for which in ("mean", "lowest", "highest")),
                    )
                    for row in rows
                ),
            )
        ],
    )


def read_perfect_splat(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment perfect-splat`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    rows: Sequence[Row] = document["found"]
    names, attacks = (list(dict.fromkeys(str(row[key]) for row in rows)) for key in ("detector", "attack"))
    hidden, nothing, shown = (_pooled(rows, key) for key in (_HIDES, _NOTHING, _SHOWS))
    known = _pooled(rows, "control_recall")
    hides = bool(hidden.total) or not shown.total
    headline = (
        Figure(label="the object is missed well inside the trigger, where it is found as it is", rate=hidden)
        if hides
        else Figure(label="the target class is reported", rate=shown)
    )
    found_before = Rate(successes=known.total - known.successes, total=known.total)
    control = (
        Figure(label="the object as it is: missed inside the trigger", rate=found_before)
        if hides
        else Figure(label="the target class, on the object as it is", rate=_pooled(rows, "control_target_rate"))
    )
    first = headline.rate or hidden
    return Section(
        title="",
        kind="CLOAK, shown perfectly",
        done=(
            f"{listed(names)} looked at path-traced pictures of what {plural(len(attacks), 'attack')} of the study "
            "wants to show, from held-out cameras inside the triggers. No splat has a part in it."
        ),
        conclusion=(
            f"A splat that shows these very pictures reaches {first.counts}, over all detectors. Where that is short "
            "of an aim, the appearance is the reason, and not the splat. One that shows them worse can be reported "
            "more often, or less."
        ),
        headline=headline,
        control=control if control.rate is not None and control.rate.total else None,
        figures=[
            Figure(label=label, rate=rate)
            for label, rate in (
                ("nothing of any class is reported on it there", nothing),
                ("the target class is reported inside the trigger of its attack", shown),
            )
            if rate.total
        ],
        counting="pictures",
        tables=[_of_attack(rows, name, names) for name in attacks],
    )


def _pooled(rows: Sequence[Row], key: str) -> Rate:
    return pooled(rate_of(row.get(key)) for row in rows)


def _of_attack(rows: Sequence[Row], attack: str, detectors: Sequence[str]) -> Table:
    """All rates of an attack, a column for each detector."""
    own = {row["detector"]: row for row in rows if row["attack"] == attack}
    keys = [key for key in RATES if any(key in row for row in own.values())]
    return Table(
        caption=f"{attack}, {next(iter(own.values()))['cameras']} cameras; for cloaked read path-traced",
        head=("", *detectors),
        rows=tuple((RATES[key], *(cell(own[name].get(key)) for name in detectors)) for key in keys),
    )
