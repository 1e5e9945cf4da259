"""A study of several optimisers: one table of all of them, and what raises a doubt about the attacks.

The doubts are those of AutoAttack (Croce and Hein, ICML 2020) and of Carlini et al. (2019): a search that knows the
loss alone, or that takes one step, must not do better than every search that follows gradients.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from attacks.optimisers.registry import OPTIMISERS
from attacks.tables import Table

AXIS = "attack.optimiser"
"""The axis over which attacks are compared."""

Group = Mapping[str, Any]


def comparison(title: str, groups: Sequence[Group]) -> Table | None:
    """Every optimiser against all else that varies: successes, and the median of the lowest losses in brackets.

    Args:
        title: Of the part of the study.
        groups: Its groups; those of one optimiser alone have no such table.
    """
    names = list(dict.fromkeys(group["labels"].get(AXIS) for group in groups))
    if len(names) < 2 or any("loss" not in group for group in groups):
        return None
    cells = {(group["labels"][AXIS], _elsewhere(group)): group for group in groups}
    columns: dict[str, Any] = {"attack": lambda name: str(name)}
    for other in dict.fromkeys(place for _, place in cells):
        columns[other or "all"] = lambda name, other=other: _reached(cells.get((name, other)))
    columns["together"] = lambda name: _count([group for (label, _), group in cells.items() if label == name])
    columns["looks"] = lambda name: _spread(groups, name, "evaluations")
    columns["CPU seconds"] = lambda name: _spread(groups, name, "cpu_seconds")
    caption = f"Attacks side by side{f': {title}' if title else ''} (successes; in brackets the lowest loss)"
    return Table.of(caption, columns, names)


def doubts(groups: Sequence[Group]) -> Iterator[str]:
    """What speaks against attacks of a study that differ in the optimiser alone.

    Args:
        groups: Of all parts.
    """
    places: dict[tuple[str, str], list[Group]] = {}
    for group in groups:
        if "loss" in group and AXIS in group["labels"]:
            places.setdefault((group["part"], _elsewhere(group)), []).append(group)
    for (part, place), members in places.items():
        where = ", ".join(filter(None, (part, place)))
        many = [group for group in members if _follows_gradients(group) and group["optimiser"] != "fgsm"]
        for group in members if many else ():
            name = group["labels"][AXIS]
            if group not in many and all(_beats(group, other) for other in many):
                what = "one step does" if group["optimiser"] == "fgsm" else f"{name}, which knows no gradient, does"
                yield f"{what} better than every attack that follows gradients ({where})"
        noise = [group for group in many if group["noise_successes"] and group["success"]["successes"]]
        if noise:
            yield f"random noise of the size of an attack succeeds, too ({where})"


def _beats(group: Group, other: Group) -> bool:
    """Whether a group has more successes than another; where neither has any, whether its loss is lower."""
    mine, theirs = group["success"]["successes"], other["success"]["successes"]
    return bool(mine > theirs or (mine == theirs == 0 and group["loss"] < other["loss"]))


def _follows_gradients(group: Group) -> bool:
    spec = OPTIMISERS.get(group["optimiser"])
    return spec is None or spec.gradient


def _elsewhere(group: Group) -> str:
    """What a group is besides its optimiser."""
    return ", ".join(str(label) for axis, label in group["labels"].items() if axis != AXIS)


def _reached(group: Group | None) -> str:
    return "-" if group is None else f"{_count([group])} ({group['loss']:.2f})"


def _count(groups: Sequence[Group]) -> str:
    rates = [group["success"] for group in groups]
    return f"{sum(rate['successes'] for rate in rates)}/{sum(rate['total'] for rate in rates)}"


def _spread(groups: Sequence[Group], name: object, key: str) -> str:
    """The smallest and the largest value of an optimiser's groups."""
    values = [group[key] for group in groups if group["labels"][AXIS] == name and group.get(key) is not None]
    if not values:
        return "-"
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"
