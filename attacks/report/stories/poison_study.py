"""What `mi-splat study run` leaves of a study of poisoned training pictures: what the victim pays and sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.observe.rows import ATTACKED, CLEAN
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section
from attacks.report.wording import listed, plain, versions_of
from attacks.studies.poison import PICTURES, summary_tables

KIND = "Poisoned training pictures"
_MOST_PICTURES = 12


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a study of poisoned training pictures.

    Args:
        folder: Where it lies.
        record: Its result.json.
    """
    values = record["values"]
    attacked = [value for value in values if ATTACKED in value["splats"]]
    most = max(attacked, key=lambda value: _times(value, ATTACKED), default=None)
    ended = [value["value"] for value in values for splat in value["splats"].values() if splat["stopped"]]
    figures = [_figure(value) for value in attacked]
    devices = listed(sorted({victim["device"] for victim in record["victims"]}))
    return Section(
        kind=KIND,
        title=str(record["name"]),
        done=(
            f"{len(record['victims'])} splats were trained, each pair on a clean set of pictures and on the poisoned "
            "one. Nothing else differs."
        ),
        conclusion=(
            "Look at the times of the clean splat first, and at the PSNR beside them: a victim sees the cost, not the "
            "attack. A defence counts only with what it takes from clean pictures."
        ),
        headline=Figure(label="most Gaussians of a poisoned splat, times the clean one's", words="-")
        if most is None
        else _figure(most, label="most Gaussians of a poisoned splat, times the clean one's"),
        counting="splats",
        figures=figures,
        warnings=[f"The victim could afford no more and ended early: {listed(ended)}."] if ended else [],
        pictures=[
            Picture(path=path, caption=_caption(path), large=path.stem.endswith("poisoned"))
            for path in sorted((folder / PICTURES).glob("*.png"))[:_MOST_PICTURES]
        ],
        charts=[_chart(attacked)],
        tables=tuple(summary_tables(record)),
        configuration=(("question", plain(record["question"])), ("device", devices)),
        versions=versions_of(record),
    )


def _times(value: Mapping[str, Any], splat: str) -> float:
    spread = value["splats"].get(splat, {}).get("times", {}).get("gaussians")
    return 0.0 if spread is None else float(spread["mean"])


def _figure(value: Mapping[str, Any], label: str = "") -> Figure:
    splat = value["splats"][ATTACKED]
    spread, psnr, control = splat["times"]["gaussians"], splat["psnr"], value["splats"][CLEAN]["psnr"]
    words = "-" if spread is None else f"{spread['mean']:.2f}"
    note = "" if spread is None or spread["count"] == 1 else f"{spread['least']:.2f} to {spread['most']:.2f} over seeds"
    if psnr is not None and control is not None:
        note += f"{'; ' * bool(note)}{psnr['mean']:.2f} dB held out, clean {control['mean']:.2f}"
    named = f"{value['part']}: {value['value']}"
    return Figure(label=label or named, words=words, note=f"{named}; {note}" if label else note)


def _caption(path: Path) -> str:
    if path.stem.endswith("poisoned"):
        return f"{path.stem}: clean above poisoned, and ten times the difference on grey."
    return f"{path.stem}: a dot where each Gaussian has its middle."


def _chart(values: Sequence[Mapping[str, Any]]) -> Chart:
    spreads = [value["splats"][ATTACKED]["times"]["gaussians"] for value in values]
    points = tuple(
        Point(x, spread["mean"], spread["least"], spread["most"])
        for x, spread in enumerate(spreads)
        if spread is not None
    )
    return Chart(
        title="Gaussians of the poisoned splat, times the clean one's",
        x_label="poison",
        y_label="times",
        lines=(Line(name="poisoned", role="attack", points=points),),
        caption="Bars go from the least to the most over the seeds.",
        ticks=tuple(value["value"] for value in values),
        level=(1.0, "clean"),
        fractions=False,
        connected=False,
    )
