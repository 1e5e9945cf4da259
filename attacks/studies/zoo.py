"""A study of several optimisers: one table of all of them, and what raises a doubt about the attacks.

The doubts are those of AutoAttack (Croce and Hein, ICML 2020) and of Carlini et al. (2019): a search that knows the
loss alone, or that takes one step, must not do better than every search that follows gradients.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from attacks.optimisers.registry import OPTIMISERS
from attacks.rate import Rate
from attacks.tables import Table

AXIS = "attack.optimiser"
"""The axis over which attacks are compared."""

Group = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """Attacks on the same, which differ in the optimiser alone."""

    name: str  # what they have in common, part and labels; empty for nothing
    many: tuple[Group, ...]
    others: tuple[Group, ...]

    @property
    def doubts(self) -> Iterator[str]:
        """What speaks against the attacks that follow gradients."""
        for group in self.others if self.many else ():
            if all(_beats(group, other) for other in self.many):
                name = group["labels"][AXIS]
                what = "one step does" if group["optimiser"] == "fgsm" else f"{name}, which knows no gradient, does"
                yield f"{what} better than every attack that follows gradients"
        if any(group["noise_successes"] and group["success"]["successes"] for group in self.many):
            yield "random noise of the size of an attack succeeds, too"


def comparison(title: str, groups: Sequence[Group]) -> Iterator[Table]:
    """Every optimiser against all else that varies, and the signs of doubt; nothing for groups of one optimiser alone.

    A cell has the successes, and in brackets the median over seeds of the lowest loss.
    """
    members = by_attack(groups)
    after = f": {title}" if title else ""
    if not members:
        return
    cells = {(group["labels"][AXIS], _elsewhere(group)): group for group in groups}
    columns: dict[str, Any] = {"attack": str}
    for other in dict.fromkeys(elsewhere for _, elsewhere in cells):
        columns[other or "all"] = lambda name, other=other: _reached(cells.get((name, other)))
    columns["together"] = lambda name: _count(together(members[name]), interval=True)
    columns["random noise"] = lambda name: "{noise_successes}/{noise_draws}".format_map(together(members[name]))
    columns["looks"] = lambda name: _spread(members[name], "evaluations")
    columns["CPU seconds"] = lambda name: _spread(members[name], "cpu_seconds")
    yield Table.of(f"Attacks side by side{after} (successes; in brackets the lowest loss)", columns, members)
    of_case: dict[str, Callable[[Case], str]] = {
        "case": lambda case: case.name or "all",
        "best with gradients": lambda case: _best(case.many),
        "best of the others": lambda case: _best(case.others),
        "doubt": lambda case: "; ".join(case.doubts) or "none",
    }
    if asked := [case for case in cases(groups) if case.many and case.others]:
        yield Table.of(f"Signs of doubt{after}", of_case, asked)


def by_attack(groups: Sequence[Group]) -> dict[str, list[Group]]:
    """The groups of each optimiser; none where all have the same, or where the study is no comparison."""
    members: dict[str, list[Group]] = {}
    for group in groups if all(_told(group) for group in groups) else ():
        members.setdefault(str(group["labels"].get(AXIS)), []).append(group)
    return members if len(members) > 1 else {}


def together(groups: Sequence[Group]) -> Group:
    """The successes of several groups, and those of their noise."""
    counts = {key: sum(group["success"][key] for group in groups) for key in ("successes", "total")}
    noise = {key: sum(group[key] for group in groups) for key in ("noise_successes", "noise_draws")}
    return {"success": Rate(**counts).as_dict(), **noise}


def cases(groups: Sequence[Group]) -> list[Case]:
    """Attacks by what they have in common besides the optimiser."""
    alike: dict[tuple[str, str], list[Group]] = {}
    for group in groups:
        if _told(group) and AXIS in group["labels"]:
            alike.setdefault((group["part"], _elsewhere(group)), []).append(group)
    return [
        Case(
            name=", ".join(filter(None, names)),
            many=tuple(group for group in members if _follows_gradients(group)),
            others=tuple(group for group in members if not _follows_gradients(group)),
        )
        for names, members in alike.items()
    ]


def doubts(groups: Sequence[Group]) -> Iterator[str]:
    """What speaks against attacks of a study that differ in the optimiser alone."""
    for case in cases(groups):
        yield from (f"{doubt} ({case.name})" for doubt in case.doubts)


def _told(group: Group) -> bool:
    """Whether a group says whether its attacks succeed, and how low their loss is."""
    return "loss" in group and "success" in group


def _beats(group: Group, other: Group) -> bool:
    """Whether a group has more successes than another; where neither has any, whether its loss is lower."""
    mine, theirs = group["success"]["successes"], other["success"]["successes"]
    return bool(mine > theirs or (mine == theirs == 0 and group["loss"] < other["loss"]))


def _follows_gradients(group: Group) -> bool:
    """Whether an attack follows them in more than one step."""
    spec = OPTIMISERS.get(group["optimiser"])
    return group["optimiser"] != "fgsm" and (spec is None or spec.gradient)


def _elsewhere(group: Group) -> str:
    """What a group is besides its optimiser."""
    return ", ".join(str(label) for axis, label in group["labels"].items() if axis != AXIS)


def _best(groups: Sequence[Group]) -> str:
    """The attack with the most successes, of equals that with the lowest loss."""
    best = max(groups, key=lambda group: (group["success"]["successes"], -group["loss"]))
    return f"{best['labels'][AXIS]}, {_reached(best)}"


def _reached(group: Group | None) -> str:
    return "-" if group is None else f"{_count(group)} ({group['loss']:.2f})"


def _count(group: Group, *, interval: bool = False) -> str:
    rate = Rate.of(group["success"])
    low, high = rate.interval
    return f"{rate.successes}/{rate.total}" + (f" ({low:.2f} to {high:.2f})" if interval else "")


def _spread(groups: Sequence[Group], key: str) -> str:
    """The mean of an optimiser's groups, with the smallest and the largest value where these differ."""
    values = [group[key] for group in groups if group.get(key) is not None]
    if not values:
        return "-"
    low, mean, high = (f"{value:.3g}" for value in (min(values), sum(values) / len(values), max(values)))
    return low if low == high else f"{mean} ({low} to {high})"
