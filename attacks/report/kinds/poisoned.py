"""What `mi-splat poison` leaves behind: which pictures of a set were changed, how much, and of CLOAK from where."""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from attacks.cloak.own_pictures import BEFORE_AND_AFTER
from attacks.rate import percent
from attacks.report.section import Chart, Figure, Picture, Section, listed, plural, settings
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
    most, idle = max((change["largest"] for change in changes), default=0.0), len(record["changes"]) - len(changes)
    figures = {
        "of each changed picture": f"{percent(min(shares))} to {percent(max(shares))}",
        "largest change of a channel": _steps(most),
        "kind": record["kind"],
    }
    if is_cloak := record["kind"] == "cloak":
        what = (
            f"those from {listed(record['hide_from'])}, and from {record['margin']:g} degrees around it. They show "
            "something else in the object's place."
        )
        outcome = "may hide the object from there; mi-splat audit says whether the splat gives it away"
        warnings = [f"{plural(idle, 'picture')} from there did not show the object, and stayed as they were"] * (
            idle > 0
        )
        heights = [change["elevation"] for change in changes] or [0.0]
        figures["elevation of their cameras"] = f"{min(heights):.0f} to {max(heights):.0f} degrees"
        figures["what is shown"] = str(record["poisonings"][0]["appearance"])
    else:
        what, outcome = _WAYS[record["kind"]]
        skipped = len(record.get("skipped", ()))
        unknown = f"{plural(skipped, 'picture')} stayed as they were: the classifier did not know the object there"
        warnings = [unknown] * (skipped > 0)
        if record["kind"] == "m-ifgsm":
            wanted = "anything else" if record["target"] is None else str(record["target"])
            figures[f"what {record['classifier']} shall see in it"] = f"{wanted}, not {record['label']}"
        if "decoy_gaussians" in record:
            grown = f"{record['decoy_gaussians']:,}, from {record['start_gaussians']:,}"
            figures["Gaussians of the attacker's model"] = grown
    columns: dict[str, Callable[[Mapping[str, Any]], str]] = {
        "picture": lambda change: picture_name("train", change["index"]),
        **{name: partial(_degrees, name) for name in ("azimuth", "elevation") if is_cloak},
        "of its pixels changed": lambda change: percent(_share(change)),
        "a channel by at most": lambda change: _steps(change["largest"]),
    }
    return Section(
        kind="poisoned pictures",
        title=folder.name,
        done=(
            f"{len(changes):,} of {plural(record['views'], 'training picture')} of {record['set']} were changed: "
            f"{what} All others, and those that are held out, are as they were."
        ),
        conclusion=(
            f"Nothing is known yet of a splat: these are pictures alone. One that is trained on them {outcome}. Train "
            "one on the clean set, too, with the same settings, and let mi-splat evaluate compare the two."
        ),
        headline=Figure(label="pictures changed", words=f"{len(changes):,} of {record['views']:,}"),
        attacked=False,
        figures=tuple(Figure(label=label, words=words) for label, words in figures.items()),
        warnings=warnings,
        pictures=(Picture(path=folder / BEFORE_AND_AFTER, caption="Some pictures, before and after.", wide=True),),
        charts=(_dome(record["directions"], {change["index"] for change in changes}),) if is_cloak else (),
        tables=(Table.of("Every changed picture", columns, changes),) * bool(changes),
        configuration=settings({name: value for name, value in record.items() if name not in _NO_SETTINGS}),
    )


def _degrees(name: str, change: Mapping[str, Any]) -> str:
    return f"{change[name]:.1f}"


def _steps(largest: float) -> str:
    """A change of a channel as people know it from 8 bits."""
    return f"{round(255 * largest)} of 255"


def _share(change: Mapping[str, Any]) -> float:
    return float(change["pixels_changed"] / change["pixels"])


def _dome(directions: Sequence[Sequence[float]], changed: Collection[int]) -> Chart:
    """Which cameras' pictures were changed."""
    numbered = list(enumerate(directions))
    return Chart.directions(
        "From where pictures were changed",
        "A mark is a camera. The middle is straight above the object, and a ring is 30 degrees.",
        {
            "changed": ("attack", [angles for index, angles in numbered if index in changed]),
            "as it was": ("control", [angles for index, angles in numbered if index not in changed]),
        },
    )
