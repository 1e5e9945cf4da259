"""What `mi-splat study run` leaves of a study of poisoned training pictures: what the victim pays, and what it sees."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.observe.rows import ATTACKED, CLEAN
from attacks.rate import Rate, pooled
from attacks.report.section import Chart, Figure, Line, Picture, Point, Role, Section, listed, plain, versions_of
from attacks.studies.poison import PICTURES
from attacks.studies.poison_figures import summary_tables
from attacks.studies.poison_jobs import HELD_OUT

KIND = "Poisoned training pictures"
_MOST_PICTURES = 12
_LARGER = "most Gaussians of a poisoned splat, times the clean one's"
_NAMED = "the object is named rightly on the poisoned splat, from held-out cameras"
_NAMED_RIGHT = "the object is found as what it is on the poisoned splat, from held-out cameras"

_SHOWN = {CLEAN: "clean splat", ATTACKED: "poisoned splat"}

Value = Mapping[str, Any]


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a study of poisoned training pictures."""
    attacked = [value for value in record["values"] if ATTACKED in value["splats"]]
    named, detected = (
        [line for line in record.get(key, ()) if line["condition"] == HELD_OUT] for key in ("classified", "detected")
    )
    label, seen = (_NAMED, named) if named else (_NAMED_RIGHT, detected)
    rates = {splat: _rate(line for line in seen if line["splat"] == splat) for splat in (CLEAN, ATTACKED)}
    ended = [value["value"] for value in record["values"] if any(s["stopped"] for s in value["splats"].values())]
    most = max(attacked, key=_times, default=None)
    larger = Figure(label=_LARGER, words="-") if most is None else _figure(most, label=_LARGER)
    return Section(
        kind=KIND,
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
        charts=[
            _seen_chart("The object is named rightly, from held-out cameras", named),
            _seen_chart("The object is found as what it is, from held-out cameras", detected),
            _chart(attacked),
        ],
        tables=tuple(summary_tables(record)),
        configuration=(
            ("question", plain(record["question"])),
            ("device", listed(sorted({victim["device"] for victim in record["victims"]}))),
        ),
        versions=versions_of(record),
    )


def _rate(lines: Iterable[Value]) -> Rate:
    """How often the object is named rightly, or found, over all values and all who look."""
    return pooled(line["right"] for line in lines)


def _finds(lines: Sequence[Value]) -> Iterator[Figure]:
    """What each detector finds, over all values."""
    for name, splat in dict.fromkeys((line["detector"], line["splat"]) for line in lines):
        rate = _rate(line for line in lines if (line["detector"], line["splat"]) == (name, splat))
        yield Figure(label=f"{name} finds the object on the {_SHOWN[splat]}, from held-out cameras", rate=rate)


def _times(value: Value) -> float:
    spread = value["splats"][ATTACKED]["times"]["gaussians"]
    return 0.0 if spread is None else float(spread["mean"])


def _figure(value: Value, label: str = "") -> Figure:
    splat, clean = value["splats"][ATTACKED], value["splats"].get(CLEAN, {})
    spread, psnr, control = splat["times"]["gaussians"], splat["psnr"], clean.get("psnr")
    notes = [f"{value['part']}: {value['value']}"] if label else []
    if spread is not None and spread["count"] > 1:
        notes.append(f"{spread['least']:.2f} to {spread['most']:.2f} over seeds")
    if psnr is not None and control is not None:
        notes.append(f"{psnr['mean']:.2f} dB held out, clean {control['mean']:.2f}")
    words = "-" if spread is None else f"{spread['mean']:.2f}"
    return Figure(label=label or f"times, {value['part']}: {value['value']}", words=words, note="; ".join(notes))


def _caption(path: Path) -> str:
    if path.stem.endswith("poisoned"):
        return f"{path.stem}: clean above poisoned, and ten times the difference on grey."
    return f"{path.stem}: a dot where each Gaussian has its middle."


def _seen_chart(title: str, seen: Sequence[Value]) -> Chart:
    values = tuple(dict.fromkeys(line["attack"] for line in seen))

    def line(splat: str, role: Role) -> Line:
        of_splat = [entry for entry in seen if entry["splat"] == splat]
        return Line.of(
            _SHOWN[splat], role, [_rate(entry for entry in of_splat if entry["attack"] == value) for value in values]
        )

    return Chart.bars(title, ("what is shown", "pictures"), values, line(CLEAN, "control"), line(ATTACKED, "attack"))


def _chart(values: Sequence[Value]) -> Chart:
    spreads = [value["splats"][ATTACKED]["times"]["gaussians"] for value in values]
    points = tuple(
        Point(x, spread["mean"], spread["least"], spread["most"])
        for x, spread in enumerate(spreads)
        if spread is not None
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
