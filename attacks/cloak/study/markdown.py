"""The figures of a study as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

ROWS = {
    "control_recall": "control found, inside the hiding trigger",
    "trigger_miss_rate": "cloaked missed, well inside it, where the control is found",
    "trigger_miss_rate_all": "cloaked missed, all inside it, where the control is found",
    "trigger_miss_rate_unconditional": "cloaked missed, well inside it",
    "trigger_miss_rate_any_overlap": "nothing of its class near it, well inside it, where the control is found",
    "nothing_reported": "nothing of any class reported on it, well inside it, where the control is found",
    "benign_recall": "cloaked found, outside of all triggers, where the control is found",
    "control_benign_recall": "control found, outside of all triggers",
    "target_rate": "target class reported on the cloaked splat",
    "control_target_rate": "target class reported on the control",
}
"""What the rates of a summary say."""


def markdown(summary: Mapping[str, Any]) -> str:
    """Tables of a summary: rates by detector and their spread over seeds, found by elevation, and the rest."""
    detectors = summary["by_detector"]
    lines = ["| | " + " | ".join(detectors) + " |", "|---" * (len(detectors) + 1) + "|"]
    for key, words in ROWS.items():
        cells = [words_of(rates[key]) + spread_of(summary, name, key) for name, rates in detectors.items()]
        if any(cells):
            lines.append(f"| {words} | " + " | ".join(cells) + " |")
    lines += ["", "| elevation | " + " | ".join(f"{name}, clean | cloaked" for name in detectors) + " |"]
    lines.append("|---" * (2 * len(detectors) + 1) + "|")
    for rows in zip(*(summary["by_elevation"][name] for name in detectors), strict=True):
        cells = [words_of(row[which], interval=False) for row in rows for which in ("clean", "cloaked")]
        lines.append(f"| {rows[0]['from']:g} to {rows[0]['to']:g} | " + " | ".join(cells) + " |")
    band, drop = summary["transition"], summary["benign_psnr_drop"]
    lines += ["", "| | |", "|---|---|"]
    lines.append(f"| seeds | {', '.join(map(str, summary['seeds']))} |")
    if band is not None and summary["transition_degrees"] is not None:
        degrees = f"{summary['transition_degrees']:.1f} degrees, from {band['from']:.1f} to {band['to']:.1f}"
        lines.append(f"| transition | {degrees} |")
        widths = sorted(width for width in band["meridians"] if width is not None)
        if widths:
            lines.append(f"| along one meridian | {widths[0]:.1f} to {widths[-1]:.1f} degrees |")
    if drop is not None:
        psnr, ssim = summary["benign_psnr"], summary["benign_ssim"]
        lines.append(f"| far from the triggers, clean | {psnr['clean']:.2f} dB, SSIM {ssim['clean']:.3f} |")
        lines.append(f"| far from the triggers, cloaked | {psnr['cloaked']:.2f} dB, SSIM {ssim['cloaked']:.3f} |")
    price = summary["stealth"]
    if price is not None:
        before, after = (price["surroundings_psnr"][which] for which in ("clean", "cloaked"))
        words = "stealthy" if price["stealthy"] else "not stealthy"
        lines.append(
            f"| beside the object, inside the trigger, clean and cloaked | {before:.2f} and {after:.2f} dB: {words} |"
        )
        lines.append(f"| on the object, against what is wanted there | {price['appearance_psnr']['cloaked']:.2f} dB |")
    for which in ("clean", "cloaked"):
        lines.append(f"| Gaussians, {which} | {', '.join(f'{n:,}' for n in summary['gaussians'][which])} |")
    return "\n".join(lines) + "\n"


def spread_of(summary: Mapping[str, Any], detector: str, key: str) -> str:
    """Least and largest of a detector's rate over the seeds, for people; empty where there is one seed."""
    found = [seed[detector].get(key) for seed in summary["by_seed"].values()]
    fractions = [rate["rate"] for rate in found if rate is not None and rate["total"]]
    return f"; by seed {min(fractions):.1%} to {max(fractions):.1%}" if len(fractions) > 1 else ""


def words_of(rate: Mapping[str, Any] | None, *, interval: bool = True) -> str:
    """A rate for people; empty if there is none."""
    if rate is None or not rate["total"]:
        return ""
    low, high = rate["interval"]
    fraction = f"{rate['successes']}/{rate['total']}"
    return f"{fraction} = {rate['rate']:.1%} ({low:.1%} to {high:.1%})" if interval else fraction
