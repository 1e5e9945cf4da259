"""What `mi-splat poison` and studies of it leave behind: which pictures were changed, and what a victim pays."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.cloak.own_pictures import BEFORE_AND_AFTER
from attacks.cloak.poisoning import CloakChange
from attacks.observe.rows import ATTACKED, CLEAN
from attacks.poisons.base import Change
from attacks.rate import Rate, percent, pooled
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section, listed, settings
from attacks.studies.poison import HELD_OUT, PICTURES
from attacks.studies.poison_figures import summary_tables
from attacks.tables import Column, Table
from mi_splat.datasets.writing import picture_name
from mi_splat.errors import counted
from mi_splat.fields import decode

Record = Mapping[str, Any]

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


def read_poisoned(folder: Path, record: Record) -> Section:
    """The section of a poisoned set."""
    is_cloak = record["kind"] == "cloak"
    every = [decode(CloakChange if is_cloak else Change, values, "change") for values in record["changes"]]
    changes = [change for change in every if change.pixels_changed]
    shares = [_share(change) for change in changes] or [0.0]
    most, idle = max((change.largest for change in changes), default=0.0), len(every) - len(changes)
    figures = {
        "of each changed picture": f"{percent(min(shares))} to {percent(max(shares))}",
        "largest change of a channel": _steps(most),
        "kind": record["kind"],
    }
    if is_cloak:
        what = (
            f"those from {listed(record['hide_from'])}, and from {record['margin']:g} degrees around it. They show "
            "something else in the object's place."
        )
        outcome = "may hide the object from there; mi-splat audit says whether the splat gives it away"
        unchanged, why = idle, "from there did not show the object, and stayed as they were"
        heights = [change.elevation for change in changes if isinstance(change, CloakChange)] or [0.0]
        figures["elevation of their cameras"] = f"{min(heights):.0f} to {max(heights):.0f} degrees"
        figures["what is shown"] = str(record["poisonings"][0]["appearance"])
    else:
        what, outcome = _WAYS[record["kind"]]
        unchanged = len(record.get("skipped", ()))
        why = "stayed as they were: the classifier did not know the object there"
        if record["kind"] == "m-ifgsm":
            wanted = "anything else" if record["target"] is None else str(record["target"])
            figures[f"what {record['classifier']} shall see in it"] = f"{wanted}, not {record['label']}"
        if "decoy_gaussians" in record:
            grown = f"{record['decoy_gaussians']:,}, from {record['start_gaussians']:,}"
            figures["Gaussians of the attacker's model"] = grown
    columns: dict[str, Column[Any]] = {"picture": lambda change: picture_name("train", change.index)}
    if is_cloak:
        columns["azimuth"] = lambda change: f"{change.azimuth:.1f}"
        columns["elevation"] = lambda change: f"{change.elevation:.1f}"
    columns["of its pixels changed"] = lambda change: percent(_share(change))
    columns["a channel by at most"] = lambda change: _steps(change.largest)
    return Section(
        kind="poisoned pictures",
        title=folder.name,
        done=(
            f"{len(changes):,} of {counted(record['views'], 'training picture')} of {record['set']} were changed: "
            f"{what} All others, and those that are held out, are as they were."
        ),
        conclusion=(
            f"Nothing is known yet of a splat: these are pictures alone. One that is trained on them {outcome}. Train "
            "one on the clean set, too, with the same settings, and let mi-splat evaluate compare the two."
        ),
        headline=Figure(label="pictures changed", words=f"{len(changes):,} of {record['views']:,}"),
        attacked=False,
        figures=Figure.each(figures),
        warnings=(f"{counted(unchanged, 'picture')} {why}",) * (unchanged > 0),
        pictures=(Picture(path=folder / BEFORE_AND_AFTER, caption="Some pictures, before and after.", wide=True),),
        charts=(_dome(record, {change.index for change in changes}),) if is_cloak else (),
        tables=(Table.of("Every changed picture", columns, changes),),
        configuration=settings({name: value for name, value in record.items() if name not in _NO_SETTINGS}),
    )


def _steps(largest: float) -> str:
    """A change of a channel as people know it from 8 bits."""
    return f"{round(255 * largest)} of 255"


def _share(change: Change) -> float:
    return change.pixels_changed / change.pixels


def _dome(record: Record, changed: Collection[int]) -> Chart:
    """Which cameras' pictures were changed."""
    numbered = list(enumerate(record["directions"]))
    return Chart.directions(
        "From where pictures were changed",
        "A mark is a camera. The middle is straight above the object, and a ring is 30 degrees.",
        {
            "changed": ("attack", [angles for index, angles in numbered if index in changed]),
            "as it was": ("control", [angles for index, angles in numbered if index not in changed]),
        },
    )


# Studies: what the victim pays, and what it sees

_MOST_PICTURES = 12
_LARGER = "most Gaussians of a poisoned splat, times the clean one's"
_NAMED = "the object is named rightly on the poisoned splat, from held-out cameras"
_FOUND = "the object is found as what it is on the poisoned splat, from held-out cameras"
_SHOWN = {CLEAN: "clean splat", ATTACKED: "poisoned splat"}


def read_study(folder: Path, record: Record) -> Section:
    """The section of a study of poisoned training pictures."""
    attacked = [value for value in record["values"] if ATTACKED in value["splats"]]
    named, detected = (
        [line for line in record.get(key, ()) if line["condition"] == HELD_OUT] for key in ("classified", "detected")
    )
    label, seen = (_NAMED, named) if named else (_FOUND, detected)
    rates = {splat: _rate(line for line in seen if line["splat"] == splat) for splat in _SHOWN}
    ended = [value["value"] for value in record["values"] if any(s["stopped"] for s in value["splats"].values())]
    most = max(attacked, key=lambda value: (_times(value) or {"mean": 0.0})["mean"], default=None)
    larger = Figure(label=_LARGER, words="-") if most is None else _figure(most, label=_LARGER)
    return Section(
        kind="Poisoned training pictures",
        title=str(record["name"]),
        done=(
            f"{len(record['victims'])} splats were trained, each pair on a clean set of pictures and on the poisoned "
            "one. Nothing else differs."
        ),
        conclusion=(
            "A poison of photographs counts only if the splat keeps it: compare the poisoned splat with the clean "
            "splat, and not with the photographs."
            if seen
            else "Look at the times of the clean splat first, and at the PSNR beside them: a victim sees the cost, not "
            "the attack. A defence counts only with what it takes from clean pictures."
        ),
        headline=Figure(label=label, rate=rates[ATTACKED]) if seen else larger,
        control=Figure(label="the same on the clean splat", rate=rates[CLEAN]) if seen else None,
        counting="pictures" if seen else "splats",
        figures=[*([larger] if seen else ()), *map(_figure, attacked), *_finds(detected)],
        warnings=[f"The victim could afford no more and ended early: {listed(ended)}."] if ended else [],
        pictures=[
            Picture(path=path, caption=_caption(path), large=path.stem.endswith("poisoned"))
            for path in sorted((folder / PICTURES).glob("*.png"))[:_MOST_PICTURES]
        ],
        charts=[_chart(attacked)],
        tables=tuple(summary_tables(record)),
        configuration=settings(
            {"question": record["question"], "device": sorted({victim["device"] for victim in record["victims"]})}
        ),
    )


def _rate(lines: Iterable[Record]) -> Rate:
    """How often the object is named rightly, or found, over all values and all who look."""
    return pooled(line["right"] for line in lines)


def _finds(lines: Sequence[Record]) -> Iterator[Figure]:
    """What each detector finds, over all values."""
    for name, splat in dict.fromkeys((line["detector"], line["splat"]) for line in lines):
        rate = _rate(line for line in lines if (line["detector"], line["splat"]) == (name, splat))
        yield Figure(label=f"{name} finds the object on the {_SHOWN[splat]}, from held-out cameras", rate=rate)


def _times(value: Record) -> Record | None:
    """How many times the Gaussians of the clean splat the poisoned one has, over seeds."""
    times: Record | None = value["splats"][ATTACKED]["times"]["gaussians"]
    return times


def _figure(value: Record, label: str = "") -> Figure:
    psnr, control = (value["splats"].get(splat, {}).get("psnr") for splat in (ATTACKED, CLEAN))
    times, name = _times(value), f"{value['part']}: {value['value']}"
    notes = [name] if label else []
    if times is not None and times["count"] > 1:
        notes.append(f"{times['least']:.2f} to {times['most']:.2f} over seeds")
    if psnr is not None and control is not None:
        notes.append(f"{psnr['mean']:.2f} dB held out, clean {control['mean']:.2f}")
    words = "-" if times is None else f"{times['mean']:.2f}"
    return Figure(label=label or f"times, {name}", words=words, note="; ".join(notes))


def _caption(path: Path) -> str:
    if path.stem.endswith("poisoned"):
        return f"{path.stem}: clean above poisoned, and ten times the difference on grey."
    return f"{path.stem}: a dot where each Gaussian has its middle."


def _chart(values: Sequence[Record]) -> Chart:
    points = tuple(
        Point(x, times["mean"], times["least"], times["most"])
        for x, value in enumerate(values)
        if (times := _times(value)) is not None
    )
    return Chart.bars(
        "Gaussians of the poisoned splat, times the clean one's",
        ("poison", "times"),
        [value["value"] for value in values],
        Line(name="poisoned", role="attack", points=points),
        caption="Bars go from the least to the most over the seeds.",
        level=(1.0, "clean"),
        fractions=False,
    )
