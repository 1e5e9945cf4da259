"""The figures of a study as tables."""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

from attacks.cloak.rates import (
    AT_LOWER,
    BAND,
    CLOAKED,
    IN_MARGIN,
    LEAST,
    LOWER,
    MARGIN,
    NAMES,
    OWN_REGION,
    RATES,
)
from attacks.rate import Rate, percent
from attacks.tables import Table, cell

RULE = (
    f"bands of {BAND:g} degrees of elevation in which it finds the control from"
    f" {LEAST:.0%} of the cameras or more"
)
"""Which elevations belong to a detector's region."""

_MARGIN_TITLES = dict(
    zip(
        IN_MARGIN,
        ("control found", "cloaked found, where the control is found"),
        strict=True,
    )
)


def tables(summary: Mapping[str, Any]) -> Iterator[Table]:
    """Tables of a summary."""
    yield from _tables(summary)
    if AT_LOWER in summary:
        lower = summary[AT_LOWER]
        rows = _rate_rows(
            {name: lower["by_detector"][name] for name in summary["by_detector"]}, lower
        )
        caption = f"Rates by detector, from a confidence of {LOWER:g}"
        yield Table(caption=caption, head=("rate", *summary["by_detector"]), rows=rows)
    for where, by_detector in summary.get(MARGIN, {}).items():
        yield _titled(f"Elsewhere, {where} of poison", _MARGIN_TITLES, by_detector)
    yield Table(
        caption="Costs", head=("what", "how much"), rows=tuple(costs(summary).items())
    )


def _tables(summary: Mapping[str, Any]) -> Iterator[Table]:
    """The rates of a clean and a cloaked splat."""
    detectors = summary["by_detector"]
    headline = headline_key(summary)
    by_seed = summary.get("by_seed", {})
    yield Table(
        caption="Rates by detector",
        head=("rate", *detectors),
        rows=_rate_rows(detectors, summary),
    )
    if OWN_REGION in summary:
        own = summary[OWN_REGION]
        where = ("its region", *(in_words(part["bands"]) for part in own.values()))
        rates = _rate_rows({name: part["rates"] for name, part in own.items()})
        caption = f"Rates of each detector in its own region: {RULE}"
        yield Table(caption=caption, head=("rate", *own), rows=(where, *rates))
    if len(by_seed) > 1:
        rows = [
            (seed, *(cell(rates[headline]) for rates in counted.values()))
            for seed, counted in by_seed.items()
        ]
        yield Table(
            caption=f"By seed: {RATES[headline]}",
            head=("seed", *detectors),
            rows=tuple(rows),
        )
    if len(summary["by_attack"]) > 1:
        rows = []
        for name, counted in summary["by_attack"].items():
            key = headline_key(next(iter(counted.values())))
            rows.append(
                (
                    f"{name}: {RATES[key]}",
                    *(cell(rates[key]) for rates in counted.values()),
                )
            )
        yield Table(caption="By attack", head=("attack", *detectors), rows=tuple(rows))
    bands = zip(*(summary["by_elevation"][name] for name in detectors), strict=True)
    rows = [
        (
            f"{band[0]['from']:g} to {band[0]['to']:g}",
            *(Rate.of(row[w]).counts for row in band for w in NAMES.values()),
        )
        for band in bands
    ]
    head = (
        "elevation",
        *(f"{name}, {which}" for name in detectors for which in NAMES.values()),
    )
    yield Table(caption="Found, by elevation", head=head, rows=tuple(rows))


def _rate_rows(
    by_detector: Mapping[str, Mapping[str, Any]], seeds: Mapping[str, Any] | None = None
) -> tuple[tuple[str, ...], ...]:
    """A row for each rate that some detector has, with its spread over seeds if these
    are given.
    """
    return tuple(
        (
            title,
            *(
                cell(rates[key]) + spread_of(seeds or {}, name, key)
                for name, rates in by_detector.items()
            ),
        )
        for key, title in RATES.items()
        if any(rates[key] is not None for rates in by_detector.values())
    )


def _titled(
    caption: str,
    titles: Mapping[str, str],
    by_detector: Mapping[str, Mapping[str, Any]],
) -> Table:
    """Rates that every detector has, by detector."""
    keys = [
        key for key in titles if all(key in rates for rates in by_detector.values())
    ]
    rows = tuple(
        (titles[key], *(cell(rates[key]) for rates in by_detector.values()))
        for key in keys
    )
    return Table(caption=caption, head=("rate", *by_detector), rows=rows)


def headline_key(rates: Mapping[str, Any]) -> str:
    """Name of the main rate: misses of an attack that hides, detections of the wanted
    class of any other.
    """
    if rates["trigger_miss_rate"] is None:
        return "target_rate"
    return "trigger_miss_rate"


def costs(summary: Mapping[str, Any]) -> dict[str, str]:
    """Costs of an attack in words: seeds, width of the transition, loss of quality, and
    numbers of Gaussians.
    """
    band = summary["transition"]
    lines = {"seeds": ", ".join(map(str, summary["seeds"]))}
    if summary["transition_degrees"] is not None:
        ends = f"from {band['from']:.1f} to {band['to']:.1f}"
        lines["transition"] = f"{summary['transition_degrees']:.1f} degrees, {ends}"
        widths = sorted(width for width in band["meridians"] if width is not None)
        if widths:
            lines["transition along one meridian"] = (
                f"{widths[0]:.1f} to {widths[-1]:.1f} degrees"
            )
    for which in NAMES.values() if summary["benign_psnr_drop"] is not None else ():
        psnr = summary["benign_psnr"][which]
        ssim = summary["benign_ssim"][which]
        lines[f"pictures far from the triggers, {which}"] = (
            f"{psnr:.2f} dB, SSIM {ssim:.3f}"
        )
    stealth = summary["stealth"]
    if stealth is not None:
        clean, cloaked = (
            stealth["surroundings_psnr"][which] for which in NAMES.values()
        )
        stealthy = "stealthy" if stealth["stealthy"] else "not stealthy"
        beside = "pictures beside the object, inside the trigger, clean and cloaked"
        lines[beside] = f"{clean:.2f} and {cloaked:.2f} dB: {stealthy}"
        intended = stealth.get("intended_surroundings_psnr")
        if intended is not None:
            shown = ", ".join(
                f"{which} {intended[which]:.2f} dB" for which in NAMES.values()
            )
            lines["the same, against what the attack shows there"] = shown
        if "object_psnr" in stealth:
            clean, cloaked = (stealth["object_psnr"][which] for which in NAMES.values())
            on_object = (
                "pictures on the object, outside beside a trigger, clean and cloaked"
            )
            lines[on_object] = f"{clean:.2f} and {cloaked:.2f} dB"
        on_it = stealth["appearance_psnr"][CLOAKED]
        lines["pictures on the object, against what is wanted there"] = (
            f"{on_it:.2f} dB"
        )
    return lines | {
        f"Gaussians, {n}": ", ".join(f"{g:,}" for g in summary["gaussians"][n])
        for n in NAMES.values()
    }


def spread_of(summary: Mapping[str, Any], detector: str, key: str) -> str:
    """Least and largest of a detector's rate over the seeds, for people; empty where
    there is one seed.
    """
    rates = [seed[detector].get(key) for seed in summary.get("by_seed", {}).values()]
    fractions = [rate["rate"] for rate in rates if rate is not None and rate["total"]]
    if len(fractions) > 1:
        return f"; by seed {percent(min(fractions))} to {percent(max(fractions))}"
    return ""


def in_words(lows: list[float]) -> str:
    """A detector's region in a few words, for instance "0 to 30, 50 to 60 degrees"; a
    dash for none.
    """
    if not lows:
        return "-"
    starts = [
        lows[0],
        *(after for before, after in pairwise(lows) if after - before > BAND),
    ]
    ends = [
        *(before + BAND for before, after in pairwise(lows) if after - before > BAND),
        lows[-1] + BAND,
    ]
    parts = (f"{low:g} to {high:g}" for low, high in zip(starts, ends, strict=True))
    return f"{', '.join(parts)} degrees"
