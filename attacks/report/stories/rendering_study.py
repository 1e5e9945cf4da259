"""What `mi-splat rendering-study` leaves behind: attacks judged in other renderers, files, and among meshes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.rate import Rate
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section, Table, doubts_of, shown
from attacks.report.wording import counted, counts, known, listed, number, plural, pooled, sentence, settings

_PRETTY = {"targeted": "the wanted class is reported", "untargeted": "the object's class is no longer reported"}
Outcome = Mapping[str, Any]


def read(folder: Path, found: Mapping[str, Any]) -> Section:
    """The section of a rendering study.

    Args:
        folder: Where it lies.
        found: Its study.json.
    """
    outcomes: Sequence[Outcome] = found["outcomes"]
    conditions = list(dict.fromkeys(one["condition"] for one in outcomes))
    rates = {name: _pooled(outcomes, "targeted", name) for name in conditions}
    first = conditions[0]
    rate, noise = rates[first], _pooled(outcomes, "noise_targeted", first)
    return Section(
        kind="attacks in other renderings",
        title=found["study"],
        folder=str(folder),
        done=f"{found['question']} {plural(found['attacks'], 'attack')}; judged under {listed(conditions)}.",
        conclusion=(
            f"Under {first} the wanted class is reported in {counts(rate)} runs, with random noise of the same sizes "
            f"in {counts(noise)}. {_extremes(rates)} Attacks of all kinds are pooled here; the tables have them apart."
        ),
        headline=Figure(label=f"{first}: runs with the wanted class", rate=rate),
        control=Figure(label=f"{first}: random noise of the same sizes", rate=noise) if noise.total else None,
        figures=tuple(
            Figure(label=f"{other}: runs with the wanted class", rate=rates[other])
            for other in conditions[1:]
            if rates[other].total
        ),
        warnings=tuple(map(sentence, [*doubts_of(rate, noise, what="runs"), *_unseen(outcomes)])),
        pictures=shown(
            [Picture(path=folder / "study.png", caption="Every attack by condition.", alt="The rates of the tables")]
        ),
        charts=tuple(_chart(outcomes, conditions, kind) for kind in _PRETTY),
        tables=(*(_table(outcomes, conditions, kind) for kind in _PRETTY), _visibility(found["image_psnr"])),
        configuration=(*settings(found["configuration"]), *settings({"weights": found["weights"]})),
        file=(f"{found['study']}.toml", found["toml"]) if found.get("toml") else None,
    )


def _pooled(outcomes: Sequence[Outcome], kind: str, condition: str) -> Rate:
    return pooled(known(one[kind]) for one in outcomes if one["condition"] == condition)


def _extremes(rates: Mapping[str, Rate]) -> str:
    counted_ones = {name: rate for name, rate in rates.items() if rate.total}
    if len(counted_ones) < 2:
        return ""
    low, high = (choose(counted_ones, key=lambda name: counted_ones[name].fraction) for choose in (min, max))
    return f"It is fewest under {low} ({counts(rates[low])}), most under {high} ({counts(rates[high])})."


def _unseen(outcomes: Sequence[Outcome]) -> Iterator[str]:
    for one in outcomes:
        rate = known(one["found"])
        if 2 * rate.successes < rate.total:
            what = f"{one['detector']} finds the clean object in {counts(rate)} runs"
            yield f"under {one['condition']} {what}, so that its rates are of few"


def _name(one: Mapping[str, Any]) -> str:
    gradient = "" if one["gradient"] == "own" else f", gradient of {one['gradient']}"
    bands = "" if one["sh_degree"] is None else f" of degree {one['sh_degree']}"
    ball = f"{one['attribute']}{bands}, {one['norm']} {one['eps']:g}"
    return f"{one['detector']}, {one['renderer']}{gradient}: {ball}"


def _table(outcomes: Sequence[Outcome], conditions: Sequence[str], kind: str) -> Table:
    cells = {(_name(one), one["condition"]): known(one[kind]) for one in outcomes}
    names = list(dict.fromkeys(_name(one) for one in outcomes))
    return Table(
        caption=f"Runs in which {_PRETTY[kind]}, of those whose clean object is found",
        head=("attack", *conditions),
        rows=tuple((name, *(counted(cells.get((name, condition))) for condition in conditions)) for name in names),
    )


def _chart(outcomes: Sequence[Outcome], conditions: Sequence[str], kind: str) -> Chart:
    lines = []
    for name, role in ((kind, "attack"), (f"noise_{kind}", "control")):
        rates = [_pooled(outcomes, name, condition) for condition in conditions]
        points = tuple(Point.of(place, rate) for place, rate in enumerate(rates) if rate.total)
        label = "all attacks" if role == "attack" else "random noise"
        lines.append(Line(name=label, role=role, points=points))  # type: ignore[arg-type]
    return Chart(
        title=f"Runs in which {_PRETTY[kind]}",
        caption="Bars are 95 % intervals; all attacks are pooled.",
        x_label="judged under",
        y_label="of the runs whose clean object is found",
        lines=tuple(lines),
        ticks=tuple(conditions),
        connected=False,
    )


def _visibility(rows: Sequence[Mapping[str, Any]]) -> Table:
    return Table(
        caption="PSNR of the attacked to the clean picture, in the renderer of the attack (median)",
        head=("attack", "PSNR"),
        rows=tuple((_name(row), number(row["psnr"], unit="dB")) for row in rows),
    )
