"""What `mi-splat dagger-transfer` leaves behind: attacks on some detectors, judged by all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from attacks.rate import Rate
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section, Table, doubts_of, shown
from attacks.report.stories.ledger import ledger
from attacks.report.wording import counted, counts, known, listed, pooled, sentence, settings, shared

KIND = "transfer of DAGGER"
HELD_OUT_KIND = "transfer of DAGGER over held-out views"
_PRETTY = {"targeted": "the wanted class is reported", "untargeted": "the object's class is gone"}

_OF_LOOKS = ("study", "scenes", "views", "weights")

Cell = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Way:
    """What sets attacks from one view each and splats for all cameras apart."""

    kind: str
    picture: str
    what: str
    done: str


_RUNS = _Way(
    kind=KIND,
    picture="transfer.png",
    what="runs",
    done="Each detector was attacked alone, and all but one at once; every detector judged every attacked splat.",
)
_VIEWS = _Way(
    kind=HELD_OUT_KIND,
    picture="held_out.png",
    what="views",
    done="Splats that were attacked from all cameras of a region were judged from views that no search has seen.",
)


def read(folder: Path, found: Mapping[str, Any]) -> Section:
    """The section of attacks from one view each.

    Args:
        folder: Where it lies; jobs/ in it has the settings.
        found: Its transfer.json.
    """
    records = ledger(folder / "jobs")
    configs = [record["job"] for record in records]
    return replace(
        _section(folder, found["cells"], _RUNS),
        configuration=(*shared(configs), *shared([{"weights": found.get("weights", {})}])),
    )


def read_held_out(folder: Path, found: Mapping[str, Any]) -> Section:
    """The section of splats that were made for all cameras, judged on held-out views.

    Args:
        folder: Where it lies.
        found: Its held_out.json.
    """
    records = ledger(folder / "held_out")
    jobs = [
        {key: value for key, value in record["job"].items() if key not in ("attack", "splat")} for record in records
    ]
    return replace(
        _section(folder, found["cells"], _VIEWS),
        configuration=(*shared(jobs), *settings({key: found[key] for key in _OF_LOOKS if key in found})),
    )


def _section(folder: Path, cells: Sequence[Cell], way: _Way) -> Section:
    """What follows from the cells; how to repeat them is not in it."""
    black = [cell for cell in cells if not cell["white_box"]]
    white = [cell for cell in cells if cell["white_box"]]
    rate, noise = _pooled(black, "targeted"), _pooled(black, "noise_targeted")
    names = list(dict.fromkeys(cell["detector"] for cell in cells))
    return Section(
        kind=way.kind,
        title=f"{len(names)} detectors",
        folder=str(folder),
        done=f"{way.done} Judges: {listed(names)}. Rates count where the judge finds the clean object.",
        conclusion=(
            f"A detector that was not attacked reports the wanted class in {counts(rate)} {way.what}; "
            f"one that was attacked in {counts(_pooled(white, 'targeted'))}. Random noise of the attacks' sizes does "
            f"so in {counts(noise)}. This says nothing of other detectors, objects or budgets."
        ),
        headline=Figure(label=f"detectors that were not attacked: {way.what} with the wanted class", rate=rate),
        control=Figure(label="random noise of the same sizes, the same detectors", rate=noise) if noise.total else None,
        figures=(
            Figure(label="attacked detectors: the wanted class", rate=_pooled(white, "targeted")),
            Figure(label="not attacked: the object's class is gone", rate=_pooled(black, "untargeted")),
            Figure(label="noise, not attacked: the object's class is gone", rate=_pooled(black, "noise_untargeted")),
        ),
        warnings=tuple(map(sentence, [*doubts_of(rate, noise, what=way.what), *_unseen(cells, way.what)])),
        pictures=shown(
            [
                Picture(
                    path=folder / way.picture,
                    caption="The matrix: rows were attacked, columns judge.",
                    alt="A heat map of the tables below",
                )
            ]
        ),
        charts=tuple(_charts(cells, names)),
        tables=tuple(_matrix(cells, names, which) for which in _PRETTY),
    )


def _pooled(cells: Sequence[Cell], which: str) -> Rate:
    return pooled(known(cell[which]) for cell in cells)


def _unseen(cells: Sequence[Cell], what: str) -> Iterator[str]:
    """Judges that do not see the clean object, and figures that noise reaches, so that they say nothing."""
    black = [cell for cell in cells if not cell["white_box"]]
    gone, noise = _pooled(black, "untargeted"), _pooled(black, "noise_untargeted")
    if gone.successes and noise.total and noise.fraction >= gone.fraction:
        yield (
            f"To detectors that were not attacked, random noise hides the object as often ({counts(noise)}) as the "
            f"attacks do ({counts(gone)})"
        )
    for cell in cells:
        total = known(cell["targeted"]).total
        if cell["runs"] and total < 0.5 * cell["runs"]:
            yield (
                f"{cell['detector']} finds the clean object in {total} of {cell['runs']} {what} of attacks on "
                f"{_source(cell)} only"
            )


def _source(cell: Cell) -> str:
    return " + ".join(cell["sources"])


def _charts(cells: Sequence[Cell], names: Sequence[str]) -> Iterator[Chart]:
    """For each attacked detector or group of them: what each judge reports, with the noise beside it."""
    for source in dict.fromkeys(_source(cell) for cell in cells):
        row = [cell for cell in cells if _source(cell) == source]
        lines = []
        for key, name, role in (("targeted", "attack", "attack"), ("noise_targeted", "random noise", "control")):
            points = [Point.of(names.index(cell["detector"]), rate) for cell in row if (rate := known(cell[key])).total]
            lines.append(Line(name=name, role="attack" if role == "attack" else "control", points=tuple(points)))
        yield Chart(
            title=f"Attacks on {source}",
            caption=f"Where {_PRETTY['targeted']}; bars are 95 % intervals.",
            x_label="judge",
            y_label="rate",
            lines=tuple(lines),
            ticks=tuple(names),
            connected=False,
        )


def _matrix(cells: Sequence[Cell], names: Sequence[str], which: str) -> Table:
    by_place = {(_source(cell), cell["detector"]): cell for cell in cells}
    rows = []
    for source in dict.fromkeys(_source(cell) for cell in cells):
        found = [by_place.get((source, name)) for name in names]
        rows.append(
            (
                source,
                *(
                    "-" if cell is None else counted(known(cell[which])) + (" (attacked)" if cell["white_box"] else "")
                    for cell in found
                ),
            )
        )
    noise = [pooled(known(cell[f"noise_{which}"]) for cell in cells if cell["detector"] == name) for name in names]
    rows.append(("random noise", *map(counted, noise)))
    title = f"{which.capitalize()}: {_PRETTY[which]}"
    return Table(caption=title, head=("attacked, judged by", *names), rows=tuple(rows))
