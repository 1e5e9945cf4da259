"""The figures of a study of CLOAK as tables."""

from collections.abc import Iterator, Mapping
from itertools import pairwise

from attacks.cloak.figures import (
    AT_LOWER,
    BAND,
    BEYOND_MARGINS,
    ELEVATION,
    LEAST,
    LOWER,
    OWN_REGION,
    WITHIN_MARGIN,
)
from attacks.figures.frame import HIGH, LOW, Figures, Number
from attacks.figures.rate import Rate, percent
from attacks.figures.tables import Column, Table, cell, groups_of
from attacks.observe.rows import ATTACKED, CLEAN

RATES = {
    "control_recall": "control found, inside the hiding trigger",
    "trigger_miss_rate": "cloaked missed, well inside it, where the control is found",
    "trigger_miss_rate_all": (
        "cloaked missed, all inside it, where the control is found"
    ),
    "trigger_miss_rate_unconditional": "cloaked missed, well inside it",
    "trigger_miss_rate_any_overlap": (
        "nothing of its class near it, well inside it, where the control is found"
    ),
    "nothing_reported": (
        "nothing of any class reported on it, well inside it, where the control is"
        " found"
    ),
    "benign_recall": (
        "cloaked found, outside of all triggers, where the control is found"
    ),
    "control_benign_recall": "control found, outside of all triggers",
    "target_rate": "target class reported on the cloaked splat",
    "control_target_rate": "target class reported on the control",
}
"""Rates of a study in words."""
_IN_MARGIN = {
    "control_benign_recall": "control found",
    "benign_recall": "cloaked found, where the control is found",
}
NAMES = {CLEAN: "clean", ATTACKED: "cloaked"}
"""Splats in words."""
RULE = (
    f"bands of {BAND:g} degrees of elevation in which it finds the control from"
    f" {LEAST:.0%} of the cameras or more"
)
"""Which elevations belong to a detector's region."""

_Line = tuple[str, str]


def tables(figures: Figures) -> Iterator[Table]:
    """All tables of a study."""
    plain = figures.where(scope=None, trigger=None, condition=None)
    yield by_detector("Rates by detector", plain, RATES)
    yield _in_regions(figures.where(scope=OWN_REGION))
    seeds = [
        group for group in groups_of(plain, "seed") if group[0]["seed"] is not None
    ]
    headline = headline_of(plain)
    if len([one for _, one in seeds if one.rates(headline)]) > 1:
        columns: dict[str, Column[tuple[Mapping[str, object], Figures]]] = {
            "seed": lambda line: line[0]["seed"],
            **{name: _rate_of(headline, name) for name in plain.labels("detector")},
        }
        yield Table.of(f"By seed: {RATES[headline]}", columns, seeds)
    yield from _by_trigger(figures)
    yield _by_elevation(figures.where(scope=ELEVATION))
    lower = figures.where(scope=AT_LOWER)
    yield by_detector(
        f"Rates by detector, from a confidence of {LOWER:g}", lower, RATES
    )
    for scope in (WITHIN_MARGIN, BEYOND_MARGINS):
        here = figures.where(scope=scope)
        if len(here):
            yield by_detector(f"Elsewhere, {scope} of poison", here, _IN_MARGIN)
    rows = tuple(costs(figures).items())
    yield Table(caption="Costs", head=("what", "how much"), rows=rows)


def _rate_of(
    measure: str, detector: str
) -> Column[tuple[Mapping[str, object], Figures]]:
    return lambda line: line[1].find(measure, detector=detector)


def by_detector(caption: str, figures: Figures, titles: Mapping[str, str]) -> Table:
    """Rates in words, a column for each detector, with their spread over seeds."""
    measures = set(figures.labels("measure"))
    lines = [line for line in titles.items() if line[0] in measures]
    columns: dict[str, Column[_Line]] = {"rate": lambda line: line[1]}
    for name in figures.labels("detector"):
        columns[name] = _with_spread(figures, name)
    return Table.of(caption, columns, lines)


def _with_spread(figures: Figures, detector: str) -> Column[_Line]:
    def text(line: _Line) -> str:
        measure, _ = line
        rate = figures.find(measure, detector=detector)
        return cell(rate) + spread_of(figures, measure, detector)

    return text


def spread_of(figures: Figures, measure: str, detector: str) -> str:
    """Least and largest of a detector's rate over the seeds, for people; empty where
    there is one seed.
    """
    seeds = figures.where(measure=measure, detector=detector).groups("seed")
    fractions = [
        rate.fraction
        for (seed,), of_seed in seeds.items()
        for _, rate in of_seed
        if seed is not None and isinstance(rate, Rate) and rate.total
    ]
    if len(fractions) < 2:
        return ""
    return f"; by seed {percent(min(fractions))} to {percent(max(fractions))}"


def _in_regions(figures: Figures) -> Table:
    table = by_detector(
        f"Rates of each detector in its own region: {RULE}", figures, RATES
    )
    regions = tuple(region_of(figures, name) for name in table.head[1:])
    rows = (("its region", *regions), *table.rows)
    return Table(caption=table.caption, head=table.head, rows=rows)


def region_of(figures: Figures, detector: str) -> str:
    """A detector's region in a few words, for instance "0 to 30, 50 to 60 degrees"; a
    dash for none.
    """
    lows = figures.where(measure="region", detector=detector).labels(LOW)
    if not lows:
        return cell(None)
    jumps = [pair for pair in pairwise(lows) if pair[1] - pair[0] > BAND]
    starts = [lows[0], *(after for _, after in jumps)]
    ends = [*(before + BAND for before, _ in jumps), lows[-1] + BAND]
    parts = (f"{low:g} to {high:g}" for low, high in zip(starts, ends, strict=True))
    return f"{', '.join(parts)} degrees"


def _by_trigger(figures: Figures) -> Iterator[Table]:
    lines = []
    for (name,), of_attack in figures.groups("trigger").items():
        if name is not None:
            lines.append((f"{name}: {RATES[headline_of(of_attack)]}", of_attack))
    if len(lines) > 1:
        columns: dict[str, Column[tuple[str, Figures]]] = {
            "attack": lambda line: line[0]
        }
        for name in lines[0][1].labels("detector"):
            columns[name] = _headline_rate(name)
        yield Table.of("By attack", columns, lines)


def _headline_rate(detector: str) -> Column[tuple[str, Figures]]:
    return lambda line: line[1].find(headline_of(line[1]), detector=detector)


def _by_elevation(figures: Figures) -> Table:
    columns: dict[str, Column[tuple[Mapping[str, object], Figures]]] = {
        "elevation": lambda line: f"{line[0][LOW]:g} to {line[0][HIGH]:g}"
    }
    for detector in figures.labels("detector"):
        for splat, name in NAMES.items():
            columns[f"{detector}, {name}"] = _counts(detector, splat)
    return Table.of("Found, by elevation", columns, groups_of(figures, LOW, HIGH))


def _counts(detector: str, splat: str) -> Column[tuple[Mapping[str, object], Figures]]:
    return lambda line: line[1].rate("found", detector=detector, splat=splat).counts


def headline_of(figures: Figures) -> str:
    """Name of the main rate: misses of an attack that hides, detections of the target
    class of any other.
    """
    hides = "trigger_miss_rate" in figures.labels("measure")
    if hides:
        return "trigger_miss_rate"
    return "target_rate"


def costs(figures: Figures) -> dict[str, str]:
    """Costs of an attack in words: width of the transition, loss of quality, and
    numbers of Gaussians.
    """
    sizes = figures.where(measure="gaussians")
    lines = {"seeds": ", ".join(map(str, sizes.labels("seed")))}
    width = figures.value("transition_degrees")
    if width is not None:
        start = figures.value("transition_from")
        end = figures.value("transition_to")
        lines["transition"] = f"{width:.1f} degrees, from {start:.1f} to {end:.1f}"
        arcs = figures.where(measure="transition_degrees")
        widths = [arc.value for key, arc in arcs if key and isinstance(arc, Number)]
        if widths:
            ends = f"{min(widths):.1f} to {max(widths):.1f} degrees"
            lines["transition along one meridian"] = ends
    for splat, name in NAMES.items():
        psnr = figures.value("benign_psnr", splat=splat)
        ssim = figures.value("benign_ssim", splat=splat)
        if psnr is not None:
            words = f"{psnr:.2f} dB, SSIM {ssim:.3f}"
            lines[f"images far from the triggers, {name}"] = words
    lines |= _stealth(figures)
    for splat, name in NAMES.items():
        numbers = [
            one.value for _, one in sizes.where(splat=splat) if isinstance(one, Number)
        ]
        lines[f"Gaussians, {name}"] = ", ".join(f"{size:,.0f}" for size in numbers)
    return lines


def _stealth(figures: Figures) -> dict[str, str]:
    lines = {}
    for measure, words in {
        "surroundings_psnr": "images around the object, inside the trigger",
        "intended_surroundings_psnr": "the same, against what the attack shows there",
        "object_psnr": "images on the object, just outside a trigger",
    }.items():
        values = [figures.value(measure, splat=splat) for splat in NAMES]
        known = [f"{value:.2f}" for value in values if value is not None]
        if known:
            lines[f"{words}, {' and '.join(NAMES.values())}"] = (
                f"{' and '.join(known)} dB"
            )
    shown = figures.value("appearance_psnr", splat=ATTACKED)
    if shown is not None:
        lines["images on the object, against what is wanted there"] = f"{shown:.2f} dB"
    stealthy = figures.value("stealthy")
    if stealthy is not None:
        lines["stealthy"] = cell(bool(stealthy))
    return lines
