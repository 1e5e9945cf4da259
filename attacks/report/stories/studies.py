"""What a study of DAGGER leaves behind: many attacks, and how others see what came of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from attacks.observe.measures import AIMS, joint_views, transfer_measures, with_control
from attacks.observe.rates import count
from attacks.observe.rows import ATTACKED, ROWS
from attacks.rate import Rate
from attacks.report.checking import Tables
from attacks.report.section import Chart, Figure, Line, Point, Role, Section, Table, doubts_of
from attacks.report.wording import (
    capital,
    counted,
    counts,
    known,
    listed,
    number,
    plural,
    pooled,
    rate_of,
    sentence,
    shared,
)

_AIMS = {
    "rate": "success",
    "clean_rate": "clean_success",
    "noise_rate": "noise_success",
    "unambiguous_rate": "unambiguous",
}
"""Rates of an attack over views, and the measures that they are."""
TITLES = {
    "pairs": "The paper's six pairs",
    "smallest": "Smaller radii",
    "curve": "Success over the radius, without a limit on the pictures",
    "psnr": "Success over the image budget",
    "pool": "Number of views in the pool (0: new ones at each step)",
    "degree": "Highest SH degree that may change (0: the same colour from everywhere)",
    "changes": "Pictures that change on their way to the detector",
    "attributes26": "Attributes at an image PSNR of 26 dB",
}
"""Parts of a study, and what tables and charts of them are called."""
_LOOKS = {"targeted": "the wanted class is reported", "untargeted": "the object's class is gone"}
_HEAD = (
    *("attack", "detectors", "what may change", "settings", "held-out views", "noise", "clean", "PSNR, dB", "steps"),
    *("seed", "seconds"),
)
_RATES = ("targeted", "untargeted", "noise_targeted", "noise_untargeted")


def figures(record: Mapping[str, Any], tables: Tables) -> Mapping[str, Any]:
    """Every figure of a study, of its rows.

    Rows that name the `sources` are looks of detectors at what came of the attacks; the others are those by which an
    attack is judged.

    Args:
        record: Its result.json, of which the settings of the attacks count.
        tables: Its rows.
    """
    rows = tables[ROWS]
    looks = rows.filter(pl.col("sources").is_not_null()) if "sources" in rows.columns else rows.clear()
    judged = rows.filter(pl.col("sources").is_null()) if "sources" in rows.columns else rows
    strange = set(rows["attack"]) - set(record["attacks"])
    if strange:
        raise ValueError(f"rows of an attack {min(strange)} that result.json does not have")
    found: dict[str, Any] = {}
    if not judged.is_empty():
        attacks = _attacks(record, judged)
        found = {"attacks": attacks, **({"smallest": smallest} if (smallest := _smallest(record, attacks)) else {})}
    return {**found, "cells": _cells(looks)} if not looks.is_empty() else found


def _attacks(record: Mapping[str, Any], rows: pl.DataFrame) -> dict[str, Any]:
    """In how many views each attack reaches its aim, and whether in enough."""
    counted = count(joint_views(rows), AIMS, ("attack",))
    found = {}
    for (name,), rates in counted.items():
        needed = record["attacks"][name]["settings"]["config"]["required_views"]
        rate = rates["success"]
        found[name] = {
            "success": rate.successes >= (needed - 1e-9) * rate.total,
            **{key: rates[measure].as_dict() for key, measure in _AIMS.items()},
        }
    return found


def _smallest(record: Mapping[str, Any], attacks: Mapping[str, Any]) -> dict[str, Any]:
    """Of attacks that were made to find the smallest ball: which was enough, and the largest that was not."""
    groups: dict[str, list[tuple[float, str]]] = {}
    for name, one in record["attacks"].items():
        if one["part"] == "smallest":
            settings = one["settings"]
            cameras, config = settings["transformations"]["cameras"], settings["config"]
            where = " ".join(f"{angle:g}" for angle in cameras["azimuths"])
            judges = " ".join(settings["detectors"])
            key = f"{settings['object']}, {settings['target']}, {judges}, {where}, {config['sh_degree']}"
            groups.setdefault(key, []).append((config["eps"][0], name))
    found = {}
    for key, members in groups.items():
        enough = min(((eps, name) for eps, name in members if attacks[name]["success"]), default=None)
        found[key] = {
            "smallest": None if enough is None else enough[0],
            "successes": None if enough is None else attacks[enough[1]]["rate"]["successes"],
            "not_enough": max((eps for eps, name in members if not attacks[name]["success"]), default=None),
        }
    return found


def _cells(looks: pl.DataFrame) -> dict[str, Any]:
    """How often attacks on some detectors deceive each one that looks."""
    counted = count(with_control(looks), transfer_measures(), ("sources", "detector"))
    runs = {group: len(rows) for group, rows in looks.filter(splat=ATTACKED).group_by("sources", "detector")}
    return {
        f"{sources.replace('+', ' + ')} by {detector}": {
            "runs": runs[sources, detector],
            **{name: rates[name].as_dict() for name in _RATES},
        }
        for (sources, detector), rates in counted.items()
    }


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a study.

    Args:
        folder: Where it lies.
        record: Its result.json.
    """
    attacks = list(record["attacks"].values())
    judged = [one for one in attacks if one.get("rate") is not None]
    looks = record.get("cells", {})
    headline, control, what = _of_looks(looks) if looks and not judged else _of_attacks(judged)
    assert headline.rate is not None
    noise = None if control is None else control.rate
    parts = dict.fromkeys(str(one["part"]) for one in judged)
    return Section(
        kind="DAGGER, a study",
        title=f"{record['name']}, {plural(len(attacks), 'attack')}",
        folder=str(folder),
        done=(
            f"{record.get('question', '')} {plural(len(attacks), 'attack')} on "
            f"{listed(sorted({name for one in attacks for name in _attacked(one)}))}. Each is judged on the saved "
            "file, in 8-bit pictures, beside random noise of its size."
        ).strip(),
        conclusion=(
            f"{capital(headline.label)}: {headline.counts}{f'; {control.label}: {control.counts}' if control else ''}. "
            "Views of one attack are not independent. This says nothing of other detectors, objects or budgets."
        ),
        headline=headline,
        control=control,
        figures=tuple(_more(record, judged)),
        warnings=tuple(
            map(sentence, [*doubts_of(headline.rate, noise, what=what), *_warnings(judged), *_unseen(looks)])
        ),
        charts=(*(_by_attack(judged, part) for part in parts), *_by_judge(looks)),
        tables=tuple(tables(record)),
        configuration=shared([*(one["settings"] for one in attacks), {"weights": record["detectors"]}]),
    )


def tables(record: Mapping[str, Any]) -> Iterator[Table]:
    """The tables of a study: the smallest balls, a line for each attack by part, and what others see."""
    if record.get("smallest"):
        rows = tuple(
            (*key.split(", "), *(number(one[value], "g") for value in ("smallest", "successes", "not_enough")))
            for key, one in record["smallest"].items()
        )
        head = ("object", "target", "detectors", "azimuths", "degree", "radius", "views", "largest that was not enough")
        yield Table(caption="Smallest radius that was enough", head=head, rows=rows)
    judged = [one for one in record["attacks"].values() if one.get("rate") is not None]
    for part in dict.fromkeys(str(one["part"]) for one in judged):
        rows = tuple(_line(one) for one in judged if str(one["part"]) == part)
        yield Table(caption=TITLES.get(part, part), head=_HEAD, rows=rows)
    if record.get("cells"):
        for name, words in _LOOKS.items():
            yield _matrix(record["cells"], name, f"{capital(name)}: {words}")


def _line(one: Mapping[str, Any]) -> tuple[str, ...]:
    """One attack as a line of a table."""
    settings, rate = one["settings"], known(one["rate"])
    config = settings["config"]
    radii = config["eps"] if len(config["eps"]) > 1 else config["eps"] * len(config["attributes"])
    change = ", ".join(f"{name} {eps:g}" for name, eps in zip(config["attributes"], radii, strict=True))
    noise, clean = known(one["noise_rate"]), known(one["clean_rate"])
    needed = settings.get("confidence")
    return (
        f"{settings['object']} to {settings['target'] or 'nothing'}",
        listed(_attacked(one)) + ("" if needed is None else f" at {needed:g}"),
        f"{config['norm']}: {change}",
        _more_settings(settings),
        counted(rate) + ("" if one["success"] else " (not enough)"),
        f"{noise.successes}/{noise.total}",
        f"{clean.successes}/{clean.total}",
        number(one.get("image_psnr")),
        f"{one.get('steps', '-')} of {config['steps']}",
        str(config["seed"]),
        number(one.get("seconds"), ".0f"),
    )


def _more_settings(settings: Mapping[str, Any]) -> str:
    """Of the other settings of an attack those that tables are about."""
    config, cameras = settings["config"], settings["transformations"]["cameras"]
    words = [f"degree {config['sh_degree']}", f"pool {config['pool']}"]
    words += [] if config["image_psnr"] is None else [f"{config['image_psnr']:g} dB asked for"]
    words.append(f"azimuths {cameras['azimuths'][0]:g} to {cameras['azimuths'][1]:g}")
    judged = settings["judged"] or settings["transformations"]
    for name, views in (("made for", settings["transformations"]), ("judged on", judged)):
        if any(value != (1.0 if key == "resize" else 0) for key, value in views["pictures"].items()):
            words.append(f"{name} changed pictures")
    return ", ".join(words)


def _attacked(one: Mapping[str, Any]) -> list[str]:
    """Names of the detectors that an attack was made on."""
    return list(map(str, one["settings"].get("detectors") or one["settings"].get("sources") or []))


def _of_attacks(judged: Sequence[Mapping[str, Any]]) -> tuple[Figure, Figure | None, str]:
    """The figure of attacks that matters, its control, and what they count."""
    members = [one for one in judged if one["part"] == "pairs"] or judged
    rate, noise = (pooled(known(one[name]) for one in members) for name in ("rate", "noise_rate"))
    of = "the paper's pairs" if members[0]["part"] == "pairs" else "all attacks"
    control = Figure(label="random noise of the same size, on the same views", rate=noise) if noise.total else None
    return Figure(label=f"held-out views of {of} with success", rate=rate), control, "held-out views"


def _of_looks(cells: Mapping[str, Any]) -> tuple[Figure, Figure | None, str]:
    """The figure of looks that matters: detectors that were not attacked."""
    others = [cell for name, cell in cells.items() if not _is_attacked(name)]
    rate, noise = (pooled(known(cell[name]) for cell in others) for name in ("targeted", "noise_targeted"))
    control = Figure(label="random noise of the same sizes, the same detectors", rate=noise) if noise.total else None
    return Figure(label="detectors that were not attacked: views with the wanted class", rate=rate), control, "views"


def _more(record: Mapping[str, Any], judged: Sequence[Mapping[str, Any]]) -> Iterator[Figure]:
    """Further figures: attacks that hold, and what becomes of the object's own class."""
    if judged:
        held = Rate(successes=sum(one["success"] for one in judged), total=len(judged))
        yield Figure(label="attacks that hold in enough views", rate=held, note="settings vary")
    cells = record.get("cells", {})
    others = [cell for name, cell in cells.items() if not _is_attacked(name)]
    own = [cell for name, cell in cells.items() if _is_attacked(name)]
    if cells:
        yield Figure(label="attacked detectors: the wanted class", rate=pooled(known(cell["targeted"]) for cell in own))
        for name, words in (("untargeted", "not attacked"), ("noise_untargeted", "noise, not attacked")):
            yield Figure(
                label=f"{words}: the object's class is gone", rate=pooled(known(cell[name]) for cell in others)
            )


def _is_attacked(name: str) -> bool:
    """Whether the detector that looks is one of those attacked."""
    sources, _, detector = name.rpartition(" by ")
    return detector in sources.split(" + ")


def _warnings(judged: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The warnings of the attacks, each once."""
    said = Counter(text for one in judged for text in one.get("warnings", ()))
    for text, times in said.items():
        yield f"{times} of {plural(len(judged), 'attack')}: {text}"


def _unseen(cells: Mapping[str, Any]) -> Iterator[str]:
    """Judges that do not see the clean object, and figures that noise reaches, so that they say nothing."""
    others = [cell for name, cell in cells.items() if not _is_attacked(name)]
    gone, noise = (pooled(known(cell[name]) for cell in others) for name in ("untargeted", "noise_untargeted"))
    if gone.successes and noise.total and noise.fraction >= gone.fraction:
        yield (
            f"to detectors that were not attacked, random noise hides the object as often ({counts(noise)}) as the "
            f"attacks do ({counts(gone)})"
        )
    for name, cell in cells.items():
        total = known(cell["targeted"]).total
        if cell["runs"] and total < 0.5 * cell["runs"]:
            sources, _, detector = name.rpartition(" by ")
            yield f"{detector} finds the clean object in {total} of {cell['runs']} views of attacks on {sources} only"


def _by_attack(judged: Sequence[Mapping[str, Any]], part: str) -> Chart:
    """The success of each attack of a part, with noise of its size."""
    members = [one for one in judged if str(one["part"]) == part]
    return Chart(
        title=TITLES.get(part, part),
        caption="Views of each attack, in the order of its table; bars are 95 % intervals.",
        x_label="attack, by its number in the table",
        y_label="views with success",
        lines=(
            _rates("attack", "attack", [one["rate"] for one in members]),
            _rates("random noise", "control", [one["noise_rate"] for one in members]),
        ),
        ticks=tuple(map(str, range(1, len(members) + 1))),
        connected=False,
    )


def _rates(name: str, role: Role, rates: Sequence[Mapping[str, Any] | None]) -> Line:
    """Rates beside each other as a line of a chart."""
    pairs = [(place, known(rate)) for place, rate in enumerate(rates) if rate is not None]
    return Line(name=name, role=role, points=tuple(Point.of(place, rate) for place, rate in pairs if rate.total))


def _by_judge(cells: Mapping[str, Any]) -> Iterator[Chart]:
    """For each group of attacked detectors what each judge reports, with the noise beside it."""
    groups, judges = _axes(cells)
    for sources in groups:
        row = [cells.get(f"{sources} by {name}", {}) for name in judges]
        yield Chart(
            title=f"Attacks on {sources}",
            caption=f"Where {_LOOKS['targeted']}; bars are 95 % intervals.",
            x_label="judge",
            y_label="rate",
            lines=(
                _rates("attack", "attack", [cell.get("targeted") for cell in row]),
                _rates("random noise", "control", [cell.get("noise_targeted") for cell in row]),
            ),
            ticks=tuple(judges),
            connected=False,
        )


def _axes(cells: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """The groups of attacked detectors, and those that look."""
    names = [name.rpartition(" by ") for name in cells]
    return list(dict.fromkeys(sources for sources, _, _ in names)), list(dict.fromkeys(one for _, _, one in names))


def _matrix(cells: Mapping[str, Any], key: str, caption: str) -> Table:
    """A row for each group of attacked detectors, a column for each that looks; noise in the last row."""
    groups, judges = _axes(cells)
    rows = []
    for sources in groups:
        names = [f"{sources} by {judge}" for judge in judges]
        own = [counted(rate_of(cells.get(name, {}).get(key))) + (" *" if _is_attacked(name) else "") for name in names]
        rows.append((sources, *own))
    noise = [
        pooled(known(cell[f"noise_{key}"]) for name, cell in cells.items() if name.endswith(f" by {judge}"))
        for judge in judges
    ]
    head = ("attacked, judged by (* attacked)", *judges)
    return Table(caption=caption, head=head, rows=(*rows, ("random noise", *map(counted, noise))))
