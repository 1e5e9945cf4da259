"""What `mi-splat poison` leaves behind: which pictures of a set were changed, and from where they were taken."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attacks.cloak.own_pictures import BEFORE_AND_AFTER
from attacks.rate import percent
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section
from attacks.report.wording import listed, plural, settings
from attacks.tables import Table
from mi_splat.datasets.writing import picture_name

_RESULTS = ("views", "changed", "changes", "directions", "poisonings", "centre", "versions", "command")
"""Of a record, what is no setting."""
_WAYS = {
    "cloak": (
        "hide the object from there",
        "They show something else in the object's place",
    ),
    "poison-splat": (
        "take more Gaussians, memory and time",
        "A splat that learned pictures of more total variation was the model for them (Poison-splat)",
    ),
    "uniform-noise": (
        "be a little worse, and not much larger: this is a control",
        "Evenly drawn noise was added to them",
    ),
    "raised-variation": (
        "grow less than with Poison-splat, for which this is a control",
        "The total variation of each was raised by itself",
    ),
}
"""What each kind may do to a splat, and what it does to pictures."""


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a poisoned set.

    Args:
        folder: Where it lies.
        record: Its poison.json.
    """
    changes = [change for change in record["changes"] if change["pixels_changed"]]
    idle, shares = len(record["changes"]) - len(changes), [_share(change) for change in changes]
    heights = [change["elevation"] for change in changes]
    return Section(
        kind="poisoned pictures",
        title=folder.name,
        done=(
            f"{len(changes):,} of {plural(record['views'], 'training picture')} of {record['set']} were changed: those "
            f"from {listed(record['hide_from'])}, and from {record['margin']:g} degrees around it. They show something "
            "else in the object's place. All others, and those that are held out, are as they were."
        ),
        conclusion=(
            "Nothing is known yet of a splat: these are pictures alone. One that is trained on them may hide the "
            "object from there. Train one on the clean set, too, and let mi-splat evaluate compare the two; mi-splat "
            "audit says whether the splat gives it away."
        ),
        headline=Figure(label="pictures changed", words=f"{len(changes):,} of {record['views']:,}"),
        attacked=False,
        figures=(
            Figure(label="of each changed picture", words=f"{percent(min(shares))} to {percent(max(shares))}"),
            Figure(label="elevation of their cameras", words=f"{min(heights):.0f} to {max(heights):.0f} degrees"),
            Figure(label="what is shown", words=str(record["poisonings"][0]["appearance"])),
        ),
        warnings=[f"{plural(idle, 'picture')} from there did not show the object, and stayed as they were"]
        * (idle > 0),
        pictures=(
            Picture(
                path=folder / BEFORE_AND_AFTER,
                caption="Some of the changed pictures, from low cameras to high ones: before, and below it after.",
                wide=True,
            ),
        ),
        charts=(_dome(record["directions"], {change["index"] for change in changes}),),
        tables=(
            Table.of(
                "Every changed picture",
                {
                    "picture": lambda change: picture_name("train", change["index"]),
                    "azimuth": lambda change: f"{change['azimuth']:.1f}",
                    "elevation": lambda change: f"{change['elevation']:.1f}",
                    "of its pixels changed": lambda change: percent(_share(change)),
                },
                changes,
            ),
        ),
        configuration=settings({name: record[name] for name in _SETTINGS}),
    )


def _share(change: Mapping[str, Any]) -> float:
    return float(change["pixels_changed"] / change["pixels"])


def _dome(directions: list[list[float]], changed: set[int]) -> Chart:
    """Which cameras' pictures were changed."""
    points = [Point(float(azimuth), float(elevation)) for azimuth, elevation in directions]
    return Chart(
        title="From where pictures were changed",
        caption="A mark is a camera. The middle is straight above the object, and a ring is 30 degrees.",
        x_label="azimuth, degrees",
        y_label="elevation, degrees",
        lines=(
            Line(name="changed", role="attack", points=tuple(p for i, p in enumerate(points) if i in changed)),
            Line(name="as it was", role="control", points=tuple(p for i, p in enumerate(points) if i not in changed)),
        ),
        fractions=False,
        connected=False,
        dome=True,
    )
