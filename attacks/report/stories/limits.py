"""Experiments that need no splat: how sharply colour can switch, and from where to paint a sign."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from attacks.rate import percent
from attacks.report.section import Chart, Figure, Line, Point, Section
from attacks.report.stories.experiments import Document, Row
from attacks.report.wording import number
from attacks.tables import Table


def read_transition_limit(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment transition-limit`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    one, two = document["found"]["one_layer"], document["found"]["two_layers"]
    bands = document["found"].get("bands", [])
    best, plain = _narrowest(two), _narrowest([row for row in one if row["emphasis"] == 1])
    return Section(
        title="",
        kind="how sharply colour can switch",
        done=(
            "Spherical harmonics were fitted to the switch that the study wants over elevation, with one layer of "
            "Gaussians and with more. No splat and no detector has a part in it."
        ),
        conclusion=(
            f"One Gaussian with one layer needs {_width(plain)} for 10 to 90 % of the way, with two layers "
            f"{_width(best)}{_with_bands(bands)}. A splat has many Gaussians and clipped colours, so its own switch "
            "may be otherwise."
        ),
        headline=Figure(label="narrowest switch, two layers", words=_width(best), note=_how(best)),
        control=Figure(label="narrowest switch, one layer", words=_width(plain), note=_how(plain)),
        attacked=False,
        charts=[chart for chart in (_by_size(two),) if chart.lines],
        tables=[
            _one(one),
            _layers(two, "Two layers", "lowest", "lowest value of a layer"),
            *([_layers(bands, "A layer more for the edge of each look", "band", "band, degrees")] if bands else []),
        ],
        warnings=["A limit of one Gaussian that is seen from everywhere, not a measurement of a splat"],
    )


def read_paint_direction(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment paint-direction`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    rows: Sequence[Row] = document["found"]
    best = max(rows, key=lambda row: float(row["smallest"]))
    where = f"{best['elevation']:g} degrees"
    return Section(
        title="",
        kind="from where to paint a sign",
        done=(
            "A texture was thrown onto the object from directions of several elevations. For each, the part of it was "
            "measured that the training cameras in the trigger see. No detector has a part in it."
        ),
        conclusion=(
            f"From {where} the camera that sees least sees {percent(best['smallest'])} of what is painted, the mean "
            f"camera {percent(best['mean'])}."
        ),
        headline=Figure(
            label=f"part that the worst camera sees, painted from {where}", words=percent(best["smallest"])
        ),
        attacked=False,
        figures=[Figure(label="part that the mean camera sees", words=percent(best["mean"]))],
        charts=[
            Chart(
                title="Part of the sign that is seen",
                caption="Over the training cameras in the trigger.",
                x_label="elevation of the direction, degrees",
                y_label="part",
                lines=tuple(
                    Line(name=name, role="other", points=tuple(Point(row["elevation"], row[key]) for row in rows))
                    for key, name in (("smallest", "worst camera"), ("mean", "mean camera"))
                ),
            )
        ],
        tables=[
            Table(
                caption="By direction",
                head=("elevation, degrees", "worst camera", "mean camera"),
                rows=tuple((f"{row['elevation']:g}", percent(row["smallest"]), percent(row["mean"])) for row in rows),
            )
        ],
    )


def _narrowest(rows: Sequence[Row]) -> Row | None:
    return min((row for row in rows if row["width"] is not None), key=lambda row: float(row["width"]), default=None)


def _width(row: Row | None) -> str:
    return "no switch" if row is None else number(row["width"], unit="degrees")


def _with_bands(rows: Sequence[Row]) -> str:
    return f", with a layer more for the edge of each look {_width(_narrowest(rows))}" if rows else ""


def _how(row: Row | None) -> str:
    if row is None:
        return ""
    size = f", largest coefficient {row['largest_coefficient']:.3g}" if "largest_coefficient" in row else ""
    return f"SH degree {row['sh_degree']}{size}"


def _by_size(rows: Sequence[Row]) -> Chart:
    lines = []
    for degree in dict.fromkeys(row["sh_degree"] for row in rows):
        own = [row for row in rows if row["sh_degree"] == degree and row["width"] is not None]
        points = tuple(Point(float(f"{row['largest_coefficient']:.3g}"), float(row["width"])) for row in own)
        lines.append(Line(name=f"SH degree {degree}", role="other", points=points))
    return Chart(
        title="What a bound on the coefficients costs, two layers",
        caption="Width of the switch, 10 to 90 % of the way. Coarse file formats do not keep large coefficients.",
        x_label="largest SH coefficient",
        y_label="degrees of elevation",
        lines=tuple(line for line in lines if line.points),
        fractions=False,
    )


def _band(row: Row) -> Iterator[str]:
    yield from (number(row[key], unit="degrees") for key in ("from", "to", "width"))


def _one(rows: Sequence[Row]) -> Table:
    return Table(
        caption="One layer",
        head=("SH degree", "emphasis", "from", "to", "width", "lowest", "highest"),
        rows=tuple(
            (
                str(row["sh_degree"]),
                f"{row['emphasis']:g}",
                *_band(row),
                number(row["lowest"], ".2f"),
                number(row["highest"], ".2f"),
            )
            for row in rows
        ),
    )


def _layers(rows: Sequence[Row], caption: str, key: str, name: str) -> Table:
    """The table of layers.

    Args:
        rows: What was measured.
        caption: Of the table.
        key: What the rows differ in, besides the degree.
        name: What it is called.
    """
    return Table(
        caption=caption,
        head=("SH degree", name, "from", "to", "width", "largest coefficient"),
        rows=tuple(
            (str(row["sh_degree"]), f"{row[key]:g}", *_band(row), number(row["largest_coefficient"], ".3g"))
            for row in rows
        ),
    )
