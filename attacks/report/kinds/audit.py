"""What `mi-splat audit` leaves behind: whether a splat shows something from some
directions only.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from attacks.figures.result import Result
from attacks.figures.tables import Column, Table
from attacks.report.section import (
    Chart,
    Figure,
    Picture,
    Role,
    Section,
    sentence,
    settings,
)
from mi_splat.audit.files import AGAINST, HEAT_PICTURE
from mi_splat.audit.results import Vector
from mi_splat.errors import counted
from mi_splat.io.folders import file_in

_ELSEWHERE = (
    *(
        "story",
        "file",
        "verdict",
        "summary",
        "objects",
        "pictures",
        "cameras",
        "lint",
        "cost",
        "against",
        "missing",
    ),
    "thresholds",
    *("command", "versions", "variant", "commit", "torch"),
)
_PLAIN = {
    "contradicted": (
        "From some directions this file shows something else than all other directions"
        " predict. Look at the images: the file, the prediction, and from where."
    ),
    "differs": (
        "From some directions an object looks unlike what the other directions predict,"
        " as it does in honest files with gloss or fog, too: information, no alarm."
    ),
    "consistent": (
        "No cone of directions contradicts the others. This does not say that the file"
        " is safe: a trigger that is narrow, weak or all around is not found."
    ),
    None: "The cameras stand on too few sides of each object to compare anything.",
}
_HOW = (
    "What each cone of directions shows was compared with what the colours and the"
    " Gaussians of all other directions predict for it."
)


def read_audit(result: Result) -> Section:
    """The section of an audit."""
    folder = result.folder
    record = result.record
    objects = record["objects"]
    findings = record.get("lint") or ()
    shared: dict[str, Any] = {
        "title": Path(record["file"]).name,
        "attacked": False,
        "configuration": settings(
            {key: value for key, value in record.items() if key not in _ELSEWHERE}
        ),
    }
    if not objects:  # lint alone was asked for, or there was nothing to look at
        return _of_numbers(shared, folder, record)
    carried = f"{record['carrying']:,} of {record['gaussians']:,}"
    limits = record["thresholds"]
    least = f"{limits['departs_with_rise']:g} or {limits['departs']:g}"
    cones = [
        {"number": number, **cone}
        for number, item in enumerate(objects, 1)
        for cone in item["cones"]
    ]
    return Section(
        **shared,
        kind="audit of a splat",
        done=f"{_done(record)} {_HOW}",
        conclusion=f"{_PLAIN[record['verdict']]} {sentence(record['summary'][0])}",
        headline=Figure(
            label="verdict",
            words=record["verdict"] or "not compared",
            note=(
                f"evidence {record['evidence']:.2f}, contradicted from 1: features"
                f" {least} apart, or the object recognised in the prediction only"
            ),
        ),
        figures=Figure.each(
            {
                "Gaussians that carry it": carried,
                "solid Gaussians near an object that was examined": (
                    f"{record['near']:.0%}"
                ),
            }
        ),
        warnings=tuple(_doubts(record)),
        pictures=tuple(_pictures(folder, record)),
        charts=tuple(_domes(record)),
        tables=(
            _cones(cones),
            _lint(findings),
            _changes(record.get("against") or {}),
        ),
    )


def _of_numbers(
    shared: dict[str, Any], folder: Path, record: Mapping[str, Any]
) -> Section:
    """The section of an audit that found no object to compare."""
    findings = record.get("lint") or ()
    errors = [row for row in findings if row["severity"] == "error"]
    lesser = len(findings) - len(errors)
    return Section(
        **shared,
        kind="audit of a splat",
        done=f"The numbers of {record['file']} were checked; {record['summary'][0]}.",
        conclusion=(
            "Hidden appearance was not judged. The rules found"
            f" {counted(len(errors), 'error')} and {counted(lesser, 'lesser thing')}."
        ),
        headline=Figure(label="errors in the numbers", words=str(len(errors))),
        warnings=[f"{row['rule']}: {row['reason']}" for row in errors],
        pictures=tuple(_overdraw(folder, record)),
        tables=(_lint(findings),),
    )


def _overdraw(folder: Path, record: Mapping[str, Any]) -> Iterator[Picture]:
    """What the splat costs from the worst camera."""
    cost = record.get("cost") or {}
    worst = cost.get("overdraw")
    if worst:
        caption = (
            "How many Gaussians lie over each other from the worst of"
            f" {counted(worst['cameras'], 'camera')}: {worst['mean']:,.0f} in the mean,"
            f" {worst['highest']:,} at most."
        )
        yield Picture(path=folder / "overdraw.png", caption=caption, large=True)


def _done(record: Mapping[str, Any]) -> str:
    """What was examined."""
    objects = record["objects"]
    many = f"{counted(len(objects), 'object')} {'was' if len(objects) == 1 else 'were'}"
    cameras = counted(sum(len(item["seen_from"]) for item in objects), "direction")
    return (
        f"In {record['file']} ({record['gaussians']:,} Gaussians) {many} viewed from"
        f" {cameras}."
    )


def _doubts(record: Mapping[str, Any]) -> Iterator[str]:
    """What the reader may not conclude."""
    if record["missing"]:
        yield record["missing"]
    if record["near"] < 0.995:
        yield (
            f"Nothing is said of {1 - record['near']:.0%} of the solid Gaussians, which"
            " lie far from every object"
        )
    for row in record.get("lint") or ():
        if row["severity"] == "error":
            count = f" ({counted(row['count'], 'Gaussian')})" if row["count"] else ""
            yield f"{row['rule']}: {row['reason']}{count}"


def _pictures(folder: Path, record: Mapping[str, Any]) -> Iterator[Picture]:
    """Cones beside their predictions, what carries them, and what changed since a clean
    file.
    """
    for shown in record["pictures"]:
        caption = (
            f"Object {shown['object'] + 1}: {shown['sentence']}. Left the file, in the"
            " middle what the other directions predict, right the cone (red)."
        )
        yield Picture(path=file_in(folder, shown["file"]), caption=caption, large=True)
    caption = (
        "The file from the clearest cone, and the same view by heat: the redder a"
        " Gaussian, the more of the contradiction it carries."
        f" {record['carrying']:,} of {record['gaussians']:,} carry most of it."
    )
    yield Picture(path=folder / HEAT_PICTURE, caption=caption, large=True)
    yield from _overdraw(folder, record)
    caption = "The two views that changed most: left the clean file, right this one."
    yield Picture(path=folder / AGAINST, caption=caption, large=True)


def _domes(record: Mapping[str, Any]) -> Iterator[Chart]:
    """From where objects contradict themselves, on the dome of directions above their
    ground.
    """
    for number, item in enumerate(record["objects"], 1):
        if item["answer"] != "contradicted":
            continue
        up = item["up"] or record.get("up") or (0.0, 0.0, 1.0)
        middle = "straight above the ground of the object" if item["up"] else "up"
        caption = (
            f"A mark is a camera. The middle is {middle}, a ring is 30 degrees, and"
            " azimuth 0 is the x axis."
        )
        sides = dict[str, tuple[Role, Iterable[tuple[float, float]]]]()
        roles: tuple[tuple[str, Role, bool], ...] = (
            ("in a contradicted cone", "attack", True),
            ("outside", "control", False),
        )
        for name, role, is_inside in roles:
            sides[name] = (
                role,
                [
                    angles(camera["direction"], up)
                    for camera in item["seen_from"]
                    if camera["contradicted"] == is_inside
                ],
            )
        title = f"From where object {number} contradicts itself"
        yield Chart.directions(title, caption, sides)


def angles(direction: Vector, up: Vector) -> tuple[float, float]:
    """Azimuth from the file's x axis and elevation above the ground of an object,
    degrees.
    """
    start = np.array((1.0, 0.0, 0.0) if abs(up[0]) < 0.9 else (0.0, 1.0, 0.0))
    east = start - np.dot(start, up) * np.array(up)
    azimuth = (
        math.degrees(
            math.atan2(np.dot(direction, np.cross(up, east)), np.dot(direction, east))
        )
        % 360
    )
    return round(azimuth, 1), round(
        math.degrees(math.asin(np.clip(np.dot(direction, up), -1, 1))), 1
    )


def _cones(cones: Sequence[Mapping[str, Any]]) -> Table:
    """Each cone beside its prediction."""
    columns: dict[str, Column[Mapping[str, Any]]] = {
        "object": lambda cone: f"object {cone['number']}",
        "cone": "where",
        "answer": "answer",
        "evidence": lambda cone: f"{cone['evidence']:.2f}",
        "features apart": lambda cone: f"{cone['distance']:.2f}",
        "prediction is more like other views by": lambda cone: f"{cone['rise']:.3f}",
        "confidence of the file": lambda cone: f"{cone['file_score']:.2f}",
        "prediction gains": lambda cone: f"{cone['gain']:.2f}",
    }
    caption = "What each cone shows beside what the other directions predict"
    return Table.of(caption, columns, cones)


def _lint(findings: Sequence[Mapping[str, Any]]) -> Table:
    """What rules about numbers have found."""
    columns: dict[str, Column[Mapping[str, Any]]] = {
        "rule": "rule",
        "severity": "severity",
        "Gaussians": lambda row: (
            f"{row['count']:,}" if row["count"] else "the whole file"
        ),
        "why it matters": "reason",
    }
    return Table.of("What is wrong with the numbers of the file", columns, findings)


def _changes(against: Mapping[str, Any]) -> Table:
    """What changed since a clean file."""
    columns: dict[str, Column[Mapping[str, Any]]] = {
        "attribute": "attribute",
        "Gaussians that changed": lambda row: f"{row['count']:,}",
        "median change": lambda row: f"{row['median']:.3g}",
        "largest": lambda row: f"{row['most']:.3g}",
        "unit": "unit",
    }
    caption = (
        f"What changed since the clean file, over {against.get('gaussians', 0):,}"
        " Gaussians"
    )
    return Table.of(caption, columns, against.get("attributes", ()))
