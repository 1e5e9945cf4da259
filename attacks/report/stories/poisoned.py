"""What `mi-splat poison` leaves behind: which pictures of a set were changed, how much, and of CLOAK from where."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from attacks.cloak.own_pictures import BEFORE_AND_AFTER
from attacks.rate import percent
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section
from attacks.report.wording import listed, plural, settings
from attacks.tables import Table
from mi_splat.datasets.writing import picture_name

_NO_SETTINGS = (
    *("views", "changed", "changes", "directions", "poisonings", "centre", "skipped"),
    *("scene_hash", "start", "start_gaussians", "decoy_gaussians"),
    *("command", "versions", "variant", "commit", "torch"),
)
"""What a record holds besides what was asked for."""
_WAYS = {
    "poison-splat": (
        "The model for them was a splat that had learned pictures of more total variation (Poison-splat).",
        "may take more Gaussians, memory and time",
    ),
    "uniform-noise": (
        "Noise was added to each, drawn evenly.",
        "should not be much larger: noise is the control of an attack that makes it larger",
    ),
    "raised-variation": (
        "The total variation of each was raised by itself.",
        "may take more Gaussians, but fewer than with Poison-splat, whose control this is",
    ),
    "m-ifgsm": (
        "In each an object was changed so that a classifier misreads it (M-IFGSM).",
        "may be misread by this classifier, or may show nothing of it: each picture was changed by itself",
    ),
}
"""What each kind but CLOAK does to pictures, and what may come of it in a splat that is trained on them."""


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a poisoned set."""
    changes = [change for change in record["changes"] if change["pixels_changed"]]
    shares = [_share(change) for change in changes] or [0.0]
    is_cloak = record["kind"] == "cloak"
    angles, directions = (("azimuth", "elevation"), [record["directions"]]) if is_cloak else ((), [])
    done, conclusion, figures, warnings, caption = (_hidden if is_cloak else _changed)(record, changes)
    many = f"{len(changes):,} of {plural(record['views'], 'training picture')} of {record['set']} were changed"
    columns: dict[str, Callable[[Mapping[str, Any]], str]] = {
        "picture": lambda change: picture_name("train", change["index"]),
        **{name: partial(_degrees, name) for name in angles},
        "of its pixels changed": lambda change: percent(_share(change)),
        "a channel by at most": lambda change: _steps(change["largest"]),
    }
    return Section(
        kind="poisoned pictures",
        title=folder.name,
        done=f"{many}{done} All others, and those that are held out, are as they were.",
        conclusion=f"Nothing is known yet of a splat: these are pictures alone. {conclusion}",
        headline=Figure(label="pictures changed", words=f"{len(changes):,} of {record['views']:,}"),
        attacked=False,
        figures=(
            Figure(label="of each changed picture", words=f"{percent(min(shares))} to {percent(max(shares))}"),
            *figures,
        ),
        warnings=warnings,
        pictures=(Picture(path=folder / BEFORE_AND_AFTER, caption=caption, wide=True),),
        charts=tuple(_dome(seen_from, {change["index"] for change in changes}) for seen_from in directions),
        tables=(Table.of("Every changed picture", columns, changes),) * bool(changes),
        configuration=settings({name: value for name, value in record.items() if name not in _NO_SETTINGS}),
    )


class _Told(NamedTuple):
    """What a section says of a kind: what was done, what may come of it, figures, warnings, what the sheet shows."""

    done: str
    conclusion: str
    figures: Sequence[Figure]
    warnings: list[str]
    caption: str


def _hidden(record: Mapping[str, Any], changes: Sequence[Mapping[str, Any]]) -> _Told:
    """CLOAK."""
    heights, idle = [change["elevation"] for change in changes] or [0.0], len(record["changes"]) - len(changes)
    return _Told(
        done=(
            f": those from {listed(record['hide_from'])}, and from {record['margin']:g} degrees around it. They show "
            "something else in the object's place."
        ),
        conclusion=(
            "One that is trained on them may hide the object from there. Train one on the clean set, too, and let "
            "mi-splat evaluate compare the two; mi-splat audit says whether the splat gives it away."
        ),
        figures=(
            Figure(
                label="elevation of their cameras",
                words=f"{min(heights):.0f} to {max(heights):.0f} degrees",
            ),
            Figure(label="what is shown", words=str(record["poisonings"][0]["appearance"])),
        ),
        warnings=[f"{plural(idle, 'picture')} from there did not show the object, and stayed as they were"]
        * (idle > 0),
        caption="Some of the changed pictures, from low cameras to high ones: before, and below it after.",
    )


def _changed(record: Mapping[str, Any], changes: Sequence[Mapping[str, Any]]) -> _Told:
    """A kind that changes pictures a little, with no regard to where they were taken."""
    wording, outcome = _WAYS[record["kind"]]
    asked = [Figure(label="kind", words=record["kind"])]
    if record["kind"] == "m-ifgsm":
        aim = "anything else" if record["target"] is None else str(record["target"])
        words = f"{aim}, not {record['label']}"
        asked.append(Figure(label=f"what {record['classifier']} shall see in it", words=words))
    if "decoy_gaussians" in record:
        grown = f"{record['decoy_gaussians']:,}, from {record['start_gaussians']:,}"
        asked.append(Figure(label="Gaussians of the attacker's model", words=grown))
    most, skipped = max((change["largest"] for change in changes), default=0.0), len(record.get("skipped", ()))
    return _Told(
        done=f". {wording}",
        conclusion=(
            f"One that is trained on them {outcome}. Train one on the clean set, too, with the same settings, and "
            "compare the two."
        ),
        figures=(Figure(label="largest change of a channel", words=_steps(most)), *asked),
        warnings=[f"{plural(skipped, 'picture')} stayed as they were, for the classifier did not know the object there"]
        * (skipped > 0),
        caption=(
            "Some of the pictures: before, after, and ten times the difference, on grey. Of a large picture it is the "
            "part around the middle of what was changed."
        ),
    )


def _degrees(name: str, change: Mapping[str, Any]) -> str:
    return f"{change[name]:.1f}"


def _steps(largest: float) -> str:
    """A change of a channel as people know it from 8 bits."""
    return f"{round(255 * largest)} of 255"


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
