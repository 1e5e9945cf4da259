"""What studies of poisoned training images leave behind: what a victim pays, and what
it sees.
"""

from collections.abc import Iterator
from pathlib import Path

from attacks.figures.frame import Figures, Number
from attacks.figures.rate import pooled
from attacks.figures.result import Result
from attacks.figures.tables import NONE
from attacks.observe.rows import ATTACKED, CLEAN
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
from attacks.studies.poison_figures import FOUND, NAMED, tables

_MOST_PICTURES = 12
_LARGER = "most Gaussians of a poisoned splat, times the clean one's"
_SEEN = {
    NAMED: "the object is named rightly on the poisoned splat, from held-out cameras",
    FOUND: (
        "the object is found as what it is on the poisoned splat, from held-out cameras"
    ),
}
_SHOWN = {CLEAN: "clean splat", ATTACKED: "poisoned splat"}

_Values = dict[tuple[str, str], Figures]
"""Figures of the splats of each part and value."""


def read_study(result: Result) -> Section:
    """The section of a study of poisoned training images."""
    record = result.record
    figures = result.figures
    values = _attacked(figures)
    largest = max(values, key=lambda value: _mean(values[value]), default=None)
    larger = Figure(label=_LARGER, words=NONE)
    if largest is not None:
        larger = _figure(largest, values[largest], label=_LARGER)
    seen = figures.having("setting", "detector").where(condition=HELD_OUT)
    measures = [measure for measure in _SEEN if measure in seen.labels("measure")]
    headline = larger
    control = None
    more = [_figure(value, splats) for value, splats in values.items()]
    if measures:
        measure = measures[0]
        attacked = seen.pooled(measure, splat=ATTACKED)
        clean = seen.pooled(measure, splat=CLEAN)
        headline = Figure(label=_SEEN[measure], rate=attacked)
        control = Figure(label="the same on the clean splat", rate=clean)
        more = [larger, *more]
    pictures = sorted((result.folder / PICTURES).glob("*.png"))[:_MOST_PICTURES]
    devices = sorted({victim["device"] for victim in record["victims"]})
    return Section(
        kind="Poisoned training images",
        title=str(record["name"]),
        done=(
            f"{len(record['victims'])} splats were trained, each pair on a clean set of"
            " images and on the poisoned one. Nothing else differs."
        ),
        conclusion=_SEEN_CONCLUSION if measures else _COST_CONCLUSION,
        headline=headline,
        control=control,
        counting="pictures" if measures else "splats",
        figures=[*more, *_finds(seen)],
        pictures=[
            Picture(
                path=path, caption=_caption(path), large=path.stem.endswith("poisoned")
            )
            for path in pictures
        ],
        charts=[_chart(values)],
        tables=tuple(tables(figures)),
        configuration=settings({"question": record["question"], "device": devices}),
    )


_SEEN_CONCLUSION = (
    "A poison of photographs counts only if the splat keeps it: compare the poisoned"
    " splat with the clean splat, and not with the photographs."
)
_COST_CONCLUSION = (
    "Look at the times of the clean splat first, and at the PSNR beside them: a victim"
    " sees the cost, not the attack. A defence counts only with what it takes from"
    " clean images."
)


def _attacked(figures: Figures) -> _Values:
    """The values that have a poisoned splat."""
    values = figures.where(detector=None).having("setting", "splat")
    return {
        (part, value): splats
        for (part, value), splats in values.groups("part", "setting").items()
        if ATTACKED in splats.labels("splat")
    }


def _times(splats: Figures) -> Number | None:
    """How many times the Gaussians of the clean splat the poisoned one has, over
    seeds.
    """
    times = splats.find("gaussians_ratio", splat=ATTACKED)
    if isinstance(times, Number):
        return times
    return None


def _mean(splats: Figures) -> float:
    return splats.value("gaussians_ratio", splat=ATTACKED) or 0.0


def _finds(seen: Figures) -> Iterator[Figure]:
    """What each detector finds, over all values."""
    for (name, splat), of_splat in seen.groups("detector", "splat").items():
        label = f"{name} finds the object on the {_SHOWN[splat]}, from held-out cameras"
        rates = of_splat.rates(FOUND)
        if rates:
            yield Figure(label=label, rate=pooled(rates))


def _figure(value: tuple[str, str], splats: Figures, label: str = "") -> Figure:
    times = _times(splats)
    psnr = splats.value("psnr", splat=ATTACKED)
    clean = splats.value("psnr", splat=CLEAN)
    name = ": ".join(value)
    notes = [name] if label else []
    if times is not None and times.least is not None and times.total != 1:
        notes.append(f"{times.least:.2f} to {times.most:.2f} over seeds")
    if psnr is not None and clean is not None:
        notes.append(f"{psnr:.2f} dB held out, clean {clean:.2f}")
    words = NONE if times is None else f"{times.value:.2f}"
    return Figure(label=label or f"times, {name}", words=words, note="; ".join(notes))


def _caption(path: Path) -> str:
    if path.stem.endswith("poisoned"):
        return (
            f"{path.stem}: clean above poisoned, and ten times the difference on grey."
        )
    return f"{path.stem}: a dot where each Gaussian has its middle."


def _chart(values: _Values) -> Chart:
    points = []
    for x, splats in enumerate(values.values()):
        times = _times(splats)
        if times is not None:
            points.append(Point(x, times.value, times.least, times.most))
    return Chart.bars(
        "Gaussians of the poisoned splat, times the clean one's",
        ("poison", "times"),
        [value for _, value in values],
        Line(name="poisoned", role="attack", points=tuple(points)),
        caption="Bars go from the least to the most over the seeds.",
        level=(1.0, "clean"),
        fractions=False,
    )
