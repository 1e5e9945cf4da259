"""What studies of poisoned training pictures leave behind: what a victim pays, and what
it sees.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.observe.rows import ATTACKED, CLEAN
from attacks.rate import Rate, pooled
from attacks.report.section import (
    Chart,
    Figure,
    Line,
    Picture,
    Point,
    Section,
    settings,
)
from attacks.studies.poison import HELD_OUT, PICTURES
from attacks.studies.poison_figures import summary_tables

Record = Mapping[str, Any]

_MOST_PICTURES = 12
_LARGER = "most Gaussians of a poisoned splat, times the clean one's"
_NAMED = "the object is named rightly on the poisoned splat, from held-out cameras"
_FOUND = (
    "the object is found as what it is on the poisoned splat, from held-out cameras"
)
_SHOWN = {CLEAN: "clean splat", ATTACKED: "poisoned splat"}


def read_study(folder: Path, record: Record) -> Section:
    """The section of a study of poisoned training pictures."""
    attacked = [value for value in record["values"] if ATTACKED in value["splats"]]
    named, detected = (
        [line for line in record.get(key, ()) if line["condition"] == HELD_OUT]
        for key in ("classified", "detected")
    )
    label, seen = (_NAMED, named) if named else (_FOUND, detected)
    rates = {
        splat: _rate(line for line in seen if line["splat"] == splat)
        for splat in _SHOWN
    }
    most = max(
        attacked,
        key=lambda value: (_times(value) or {"mean": 0.0})["mean"],
        default=None,
    )
    if most is None:
        larger = Figure(label=_LARGER, words="-")
    else:
        larger = _figure(most, label=_LARGER)
    return Section(
        kind="Poisoned training pictures",
        title=str(record["name"]),
        done=(
            f"{len(record['victims'])} splats were trained, each pair on a clean set of"
            " pictures and on the poisoned one. Nothing else differs."
        ),
        conclusion=(
            "A poison of photographs counts only if the splat keeps it: compare the"
            " poisoned splat with the clean splat, and not with the photographs."
            if seen
            else (
                "Look at the times of the clean splat first, and at the PSNR beside"
                " them: a victim sees the cost, not the attack. A defence counts only"
                " with what it takes from clean pictures."
            )
        ),
        headline=Figure(label=label, rate=rates[ATTACKED]) if seen else larger,
        control=(
            Figure(label="the same on the clean splat", rate=rates[CLEAN])
            if seen
            else None
        ),
        counting="pictures" if seen else "splats",
        figures=[
            *([larger] if seen else ()),
            *map(_figure, attacked),
            *_finds(detected),
        ],
        pictures=[
            Picture(
                path=path, caption=_caption(path), large=path.stem.endswith("poisoned")
            )
            for path in sorted((folder / PICTURES).glob("*.png"))[:_MOST_PICTURES]
        ],
        charts=[_chart(attacked)],
        tables=tuple(summary_tables(record)),
        configuration=settings(
            {
                "question": record["question"],
                "device": sorted({victim["device"] for victim in record["victims"]}),
            }
        ),
    )


def _rate(lines: Iterable[Record]) -> Rate:
    """How often the object is named rightly, or found, over all values and all who
    look.
    """
    return pooled(line["right"] for line in lines)


def _finds(lines: Sequence[Record]) -> Iterator[Figure]:
    """What each detector finds, over all values."""
    for name, splat in dict.fromkeys(
        (line["detector"], line["splat"]) for line in lines
    ):
        rate = _rate(
            line for line in lines if (line["detector"], line["splat"]) == (name, splat)
        )
        yield Figure(
            label=(
                f"{name} finds the object on the {_SHOWN[splat]}, from held-out cameras"
            ),
            rate=rate,
        )


def _times(value: Record) -> Record | None:
    """How many times the Gaussians of the clean splat the poisoned one has, over
    seeds.
    """
    times: Record | None = value["splats"][ATTACKED]["times"]["gaussians"]
    return times


def _figure(value: Record, label: str = "") -> Figure:
    psnr, control = (
        value["splats"].get(splat, {}).get("psnr") for splat in (ATTACKED, CLEAN)
    )
    times = _times(value)
    name = f"{value['part']}: {value['value']}"
    notes = [name] if label else []
    if times is not None and times["count"] > 1:
        notes.append(f"{times['least']:.2f} to {times['most']:.2f} over seeds")
    if psnr is not None and control is not None:
        notes.append(f"{psnr['mean']:.2f} dB held out, clean {control['mean']:.2f}")
    words = "-" if times is None else f"{times['mean']:.2f}"
    return Figure(label=label or f"times, {name}", words=words, note="; ".join(notes))


def _caption(path: Path) -> str:
    if path.stem.endswith("poisoned"):
        return (
            f"{path.stem}: clean above poisoned, and ten times the difference on grey."
        )
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
