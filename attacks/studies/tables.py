"""The tables of a study of DAGGER, of its figures (`attacks.studies.result`)."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from attacks.figures.frame import AXIS, Figures, Number
from attacks.figures.rate import number, pooled
from attacks.figures.tables import (
    Column,
    Group,
    Table,
    cell,
    groups_of,
    label_at,
    number_at,
    short_rate,
)
from attacks.observe.rows import ATTACKED, CONTROLS, NOISE
from attacks.studies.result import ALL_PAIRS, EVALUATION, SEARCH, SETTING, WHITE_BOX

OPTIMISER = f"{AXIS}attack.optimiser"
"""The axis over which attacks are compared."""
PAIR = f"{AXIS}pair"
KINDS = {
    "targeted": "The wanted class is reported",
    "untargeted": "The object's class is no longer reported",
    "reached": "The objective of the attack is reached",
}
"""What is counted of evaluations."""


def tables(figures: Figures) -> Iterator[Table]:
    """What the attacks have reached, the smallest that suffices, and what others
    report.
    """
    for part, settings in of_parts(figures, SETTING):
        pairs = figures.where(scope=ALL_PAIRS, part=part)
        yield from [*comparison(part, settings)] or [_settings(part, settings, pairs)]
    for part, searches in of_parts(figures, SEARCH):
        caption = _titled("The smallest that suffices", part)
        columns = {**_axes(searches), **_OF_SEARCHES}
        yield Table.of(caption, columns, groups_of(searches, "setting", *searches.axes))
    for part, evaluations in of_parts(figures, EVALUATION):
        known = evaluations.labels("measure")
        for kind, meaning in KINDS.items():
            if kind in known:
                yield _matrix(_titled(meaning, part), evaluations, kind)


def of_parts(figures: Figures, scope: str) -> list[tuple[str, Figures]]:
    """The figures of a scope by the parts of the study."""
    parts = figures.where(scope=scope).groups("part")
    return [(part or "", of_part) for (part,), of_part in parts.items()]


def _titled(caption: str, part: str) -> str:
    if part:
        return f"{caption}: {part}"
    return caption


def title_of(axis: str) -> str:
    """What an axis is called at the head of a column."""
    return axis.removeprefix(AXIS).removeprefix("attack.").replace("_", " ")


def _axes(figures: Figures) -> dict[str, Column[Group]]:
    return {title_of(axis): label_at(axis) for axis in figures.axes}


def settings_of(figures: Figures) -> list[Group]:
    """The figures of attacks by what varies."""
    return groups_of(figures, *figures.axes)


def _settings(part: str, settings: Figures, pairs: Figures) -> Table:
    """What attacks have reached by what varies, and that of all pairs together."""
    lines = settings_of(settings)
    together = groups_of(pairs, *settings.axes)
    if len(lines) > len(together):
        lines += [({**labels, PAIR: "all"}, figures) for labels, figures in together]
    columns = {**_axes(settings), **_COLUMNS}
    return Table.of(part or "The attacks", columns, lines).filled


def _score(group: Group) -> str | None:
    score = group[1].find("score", splat=ATTACKED)
    if not isinstance(score, Number):
        return None
    return f"{number(score.value, '.2f')} ({number(score.least, '.2f')})"


def _of_control(name: str) -> dict[str, Column[Group]]:
    """What a control reaches where the clean object is detected."""
    return {
        f"{name}: strict": short_rate("strict_if_detected", splat=name),
        f"{name}: target class": short_rate("success_if_detected", splat=name),
        f"{name}: own class lost": short_rate("lost_if_detected", splat=name),
        f"{name}: dB on the object": number_at(
            "psnr_object_if_detected", ".1f", splat=name
        ),
    }


_COLUMNS: dict[str, Column[Group]] = {
    "success": short_rate("reached", splat=ATTACKED),
    "strictly": short_rate("reached_strictly", splat=ATTACKED),
    "confidence (least)": _score,
    "original after": number_at("original_after"),
    "clean object detected": short_rate("detected", splat=ATTACKED),
    "strict, if detected": short_rate(
        "strict_if_detected", interval=True, splat=ATTACKED
    ),
    "target class, if detected": short_rate("success_if_detected", splat=ATTACKED),
    "dB on the object, if detected": number_at(
        "psnr_object_if_detected", ".1f", splat=ATTACKED
    ),
    **{head: column for name in CONTROLS for head, column in _of_control(name).items()},
    "views": short_rate("success", interval=True, splat=ATTACKED),
    "views, strictly": short_rate("strict", splat=ATTACKED),
    "views, noise": short_rate("success", splat=NOISE),
    "views, clean": short_rate("success", splat="clean"),
    "steps": number_at("steps", "g"),
    "PSNR, dB": number_at("image_psnr", ".1f"),
    "on the object": number_at("psnr_object", ".1f"),
    "noise success": short_rate("reached", splat=NOISE),
    "noise best": number_at("best_score", splat=NOISE),
    "seconds": number_at("seconds", ".0f"),
}
_OF_SEARCHES: dict[str, Column[Group]] = {
    "smallest": number_at("smallest", "g"),
    "largest that does not": number_at("not_enough", "g"),
}


def _matrix(caption: str, evaluations: Figures, kind: str) -> Table:
    """What evaluates, and how, against what was attacked; the longer of the two
    downwards, and the noise of all of it.
    """
    axes = evaluations.axes
    lines = groups_of(evaluations, "condition", "detector", "access", *axes)
    labels = [labels for labels, _ in lines]
    evaluators = _names(labels, ("condition", "detector"))
    attacks = _names(labels, axes)
    marked = len(evaluations.labels("detector")) > 1
    turned = len(set(attacks)) > len(set(evaluators))
    down, across = (attacks, evaluators) if turned else (evaluators, attacks)
    cells: dict[tuple[str, str], str] = {}
    noise: dict[str, list[Any]] = {}
    for row, column, (of_line, figures) in zip(down, across, lines, strict=True):
        star = " *" if marked and of_line["access"] == WHITE_BOX else ""
        cells[row, column] = f"{figures.rate(kind).short(interval=True)}{star}"
        noise.setdefault(row, []).append(figures.rate(f"noise_{kind}"))

    def at(column: str) -> Column[str]:
        return lambda row: cells.get((row, column))

    heading = "attacked, evaluated by" if turned else "evaluated by"
    columns: dict[str, Column[str]] = {heading: lambda row: row or "all"}
    for name in dict.fromkeys(across):
        columns[name or "all"] = at(name)
    columns["random noise"] = lambda row: pooled(noise[row]).short()
    note = " (a star: the evaluating detector was attacked)" if marked else ""
    return Table.of(f"{caption}{note}", columns, noise)


def _names(lines: Sequence[Mapping[str, Any]], keys: Iterable[str]) -> list[str]:
    """What each line is called by those of its labels that are not the same in all."""
    several = [key for key in keys if len({line[key] for line in lines}) > 1]
    return [
        ", ".join(_named(key, line[key]) for key in several if line[key] is not None)
        for line in lines
    ]


def _named(key: str, label: str) -> str:
    """A label that is a number, with the name of its axis."""
    is_number = label.replace(".", "", 1).isdigit()
    if is_number:
        return f"{title_of(key)} {label}"
    return label


# Several optimisers in one study


def by_optimiser(settings: Figures) -> dict[str, Figures]:
    """The figures of each optimiser; none of a study that compares none."""
    if not {"loss", "reached"} <= set(settings.labels("measure")):
        return {}
    groups = settings.groups(OPTIMISER)
    if len(groups) < 2:
        return {}
    return {str(optimiser): figures for (optimiser,), figures in groups.items()}


def comparison(part: str, settings: Figures) -> Iterator[Table]:
    """Every optimiser against all else that varies; nothing for only one optimiser.

    A cell has the successes, and in brackets the median over seeds of the lowest loss.
    """
    members = by_optimiser(settings)
    if not members:
        return
    others = [axis for axis in settings.axes if axis != OPTIMISER]
    columns: dict[str, Column[str]] = {"attack": str}
    for labels, _ in groups_of(settings, *others):
        name = ", ".join(str(label) for label in labels.values() if label is not None)
        columns[name or "all"] = _reached(members, labels)
    columns["together"] = lambda name: (
        members[name].pooled("reached", splat=ATTACKED).short(interval=True)
    )
    columns["random noise"] = lambda name: (
        members[name].pooled("reached", splat=NOISE).short()
    )
    columns["evaluations"] = lambda name: _spread(members[name], "evaluations")
    columns["CPU seconds"] = lambda name: _spread(members[name], "cpu_seconds")
    note = "(successes; in brackets the lowest loss)"
    yield Table.of(f"{_titled('Attacks side by side', part)} {note}", columns, members)


def _reached(members: Mapping[str, Figures], labels: Mapping[str, Any]) -> Column[str]:
    def text(name: str) -> str | None:
        figures = members[name].where(**labels)
        loss = figures.value("loss")
        if loss is None:
            return None
        return f"{figures.rate('reached', splat=ATTACKED).short()} ({loss:.2f})"

    return text


def _spread(figures: Figures, measure: str) -> str:
    """The mean over an optimiser's settings, with the range where they differ."""
    found = figures.where(measure=measure)
    values = [one.value for _, one in found if isinstance(one, Number)]
    if not values:
        return cell(None)
    mean = sum(values) / len(values)
    low, middle, high = (f"{value:.3g}" for value in (min(values), mean, max(values)))
    if low == high:
        return low
    return f"{middle} ({low} to {high})"
