"""Draws what hiding from the audit costs: `python docs/figures/audit_price.py [FILE.csv [PICTURE]]`.

FILE is written by `python -m scenes.recipes.audit_price`. A panel for each object: the drift net of gloss against the
share of the trigger's cameras at which the detector misses the object.
"""

import csv
import sys
from pathlib import Path

from mi_splat.audit.thresholds import LIMITS

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "docs" / "tables" / "audit_price.csv"
PICTURE = ROOT / "docs" / "images" / "audit_price.png"
KEPT = 0.8
"""Share of the cameras outside that still have to find the object; below it the object is changed for all."""
NARROW = 20.0
"""Degrees from the axis of a trigger to its edge below which it is narrow."""
_LEAST = 3e-4
"""Excess at which what is smaller is drawn."""
_MARKS = {
    "found from outside": ("o", "tab:red"),
    "found from outside, narrow trigger": ("v", "tab:orange"),
    "changed from outside, too": ("x", "tab:gray"),
}
"""Price to marker and colour."""


def main(table: Path = TABLE, picture: Path = PICTURE) -> None:
    """Draw."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = list(dict.fromkeys(row["object"] for row in rows))
    figure, axes = pyplot.subplots(1, len(names), figsize=(3.4 * len(names), 3.8), sharey=True, squeeze=False)
    for axis, name in zip(axes[0], names, strict=True):
        for label, (marker, colour) in _MARKS.items():
            part = [row for row in rows if row["object"] == name and _price(row) == label]
            missed = [float(row["missed"]) for row in part]
            excess = [max(float(row["net"]), _LEAST) for row in part]
            axis.scatter(missed, excess, marker=marker, c=colour, s=34, label=label, clip_on=False, zorder=3)
        for level, line, text in (
            (LIMITS.net, "-", "hidden look"),
            (LIMITS.suspicion * LIMITS.net, ":", "suspicious"),
        ):
            axis.axhline(level, color="black", linewidth=1, linestyle=line)
            axis.text(0.35, level, text, va="bottom" if line == "-" else "top", fontsize=8)
        axis.set(
            title=name, xlabel="missed from inside the trigger", xlim=(-0.03, 1.03), yscale="log", ylim=(_LEAST, 0.2)
        )
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("drift net of gloss")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="lower center", ncols=3, fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    figure.savefig(picture, dpi=110)


def _price(row: dict[str, str]) -> str:
    """What the attacker pays, in the words of the legend."""
    if float(row["kept"]) < KEPT:
        return "changed from outside, too"
    return "found from outside" if float(row["half_width"]) >= NARROW else "found from outside, narrow trigger"


if __name__ == "__main__":
    main(*[Path(word) for word in sys.argv[1:3]])
