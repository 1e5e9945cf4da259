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
from mi_splat.audit.files import AGAINST
from mi_splat.audit.held_out_files import contradiction_file
from mi_splat.audit.results import Vector
from mi_splat.audit.thresholds import LIMITS
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
        "held_out",
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
        "Colours or features change with the direction of view, as they do in honest"
        " files with gloss or fog, too: information, no alarm. Look at the images."
    ),
    "consistent": (
        "No cone of directions contradicts the others. This does not say that the file"
        " is safe: see what was not judged."
    ),
    # of results that an earlier version wrote
    "hidden look": (
        "This file hides something: an object has other colours from some directions"
        " than from all others, and no gloss explains it. Look at the two pictures."
    ),
    "suspicious": (
        "This file is suspicious, which proves nothing: look at the pictures and at the"
        " directions before you trust it."
    ),
    "nothing found": (
        "No hidden look was found. This does not say that the file is safe: see what"
        " was not judged."
    ),
}
_HOW = (
    "For each set of directions the colours of the same surface from inside and from"
    " outside were compared, and what honest gloss explains was taken off."
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
        errors = [row for row in findings if row["severity"] == "error"]
        return Section(
            **shared,
            kind="audit of a splat",
            done=(
                f"The numbers of {record['file']} were checked; {record['summary'][0]}."
            ),
            conclusion=(
                "Hidden appearance was not judged. The rules found"
                f" {counted(len(errors), 'error')} and"
                f" {counted(len(findings) - len(errors), 'lesser thing')}."
            ),
            headline=Figure(label="errors in the numbers", words=str(len(errors))),
            warnings=[f"{row['rule']}: {row['reason']}" for row in errors],
            pictures=tuple(_overdraw(folder, record)),
            tables=(_lint(findings),),
        )
    looks = [
        {"object": number, "look": index, **look}
        for number, index, look in _looks(objects)
    ]
    carried = f"{record['carrying']:,} of {record['gaussians']:,}"
    net = max(look["net"] for look in looks)
    least = looks[0]["threshold"]
    return Section(
        **shared,
        kind="audit of a splat",
        done=f"{_done(record)} {_HOW}",
        conclusion=(
            f"{_PLAIN[record['verdict']]}"
            f" {sentence(record['summary'][0].partition(': ')[2])}"
        ),
        headline=Figure(
            label="verdict",
            words=record["verdict"],
            note=f"drift net of gloss {net:.5f}; hidden from {least:g}",
        ),
        figures=Figure.each(
            {
                "Gaussians that carry it": carried,
                "solid Gaussians near an object that was looked at": (
                    f"{record['near']:.0%}"
                ),
            }
        ),
        warnings=tuple(_doubts(record)),
        pictures=tuple(_pictures(folder, record)),
        charts=tuple(
            chart for number in range(len(objects)) for chart in _domes(record, number)
        ),
        tables=(
            *_tables(record, looks),
            _lint(findings),
            _changes(record.get("against") or {}),
        ),
    )


def _looks(
    objects: Sequence[Mapping[str, Any]],
) -> Iterator[tuple[int, int, Mapping[str, Any]]]:
    for number, item in enumerate(objects, 1):
        yield from ((number, index, look) for index, look in enumerate(item["looks"]))


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
    """What was looked at."""
    objects = record["objects"]
    many = f"{counted(len(objects), 'object')} {'was' if len(objects) == 1 else 'were'}"
    cameras = counted(sum(len(item["seen_from"]) for item in objects), "direction")
    return (
        f"In {record['file']} ({record['gaussians']:,} Gaussians) {many} looked at from"
        f" {cameras}."
    )


def _doubts(record: Mapping[str, Any]) -> Iterator[str]:
    """What the reader may not conclude."""
    for number, item in enumerate(record["objects"], 1):
        share = item["uncontradicted"] / max(
            item["uncontradicted"] + item["area"], 1e-12
        )
        if share >= 0.005:
            yield (
                f"Object {number}: {share:.0%} of the surface that shows is seen from"
                " one side or by few cameras. Nothing contradicts what is shown there,"
                " so nothing can be said of it"
            )
        if item["fogged"]:
            yield (
                f"Object {number}: one side shows fog, so no training camera may have"
                " stood there: pass --cameras"
            )
        if _is_covered(record, item):
            yield (
                f"Object {number}: something in the air covers it from around"
                f" ({_numbers(item['occluder']['axis'])}), and other cameras look"
                " through it. An honest canopy may do the same"
            )
        edit = item.get("edited")
        if edit and edit["score"] >= 1:
            if edit["camera"]:
                camera = f", aimed at a camera towards ({_numbers(edit['camera'])})"
            else:
                camera = ""
            yield (
                f"Object {number}: its colours have shades that neither paint nor light"
                f" explains{camera}. An attack on a detector leaves such; a training by"
                " photographs does not"
            )
    if record["near"] < 0.995:
        yield (
            f"Nothing is said of {1 - record['near']:.0%} of the solid Gaussians, which"
            " lie far from every object"
        )
    for row in record.get("lint") or ():
        if row["severity"] == "error":
            count = f" ({counted(row['count'], 'Gaussian')})" if row["count"] else ""
            yield f"{row['rule']}: {row['reason']}{count}"


def _is_covered(record: Mapping[str, Any], item: Mapping[str, Any]) -> bool:
    """Whether something in the air covers an object from some directions."""
    return bool(
        item["occluder"]
        and item["occluder"]["score"] >= record["thresholds"]["covered"]
    )


def _pictures(folder: Path, record: Mapping[str, Any]) -> Iterator[Picture]:
    """Contradicted cones, the pairs that show appearances, the heat, and what changed
    since a clean file.
    """
    thresholds = record["thresholds"]
    contradictions = record.get("held_out", {}).get("contradictions", ())
    for number, text in enumerate(contradictions):
        caption = (
            f"{sentence(text)} Left the file, in the middle what the other directions"
            " predict, right the cone of directions (red)."
        )
        shown_in = folder / contradiction_file(number)
        yield Picture(path=shown_in, caption=caption, large=True)
    for shown in record["pictures"]:
        looks = record["objects"][shown["object"]]["looks"]
        name = f"Object {shown['object'] + 1}" + (
            f", look {shown['look'] + 1}" if len(looks) > 1 else ""
        )
        look = looks[shown["look"]]
        proven = look["net"] / look["threshold"] >= thresholds["suspicion"]
        caption = (
            f"{name}: the same surface, left from inside of the directions from which"
            f" {'the look shows' if proven else 'colours differ most'}, right from"
            f" outside. The surface that both see differs by {shown['change']:.2f} in"
            " the mean (sRGB, 0 to 1)."
        )
        yield Picture(path=file_in(folder, shown["file"]), caption=caption, large=True)
    caption = (
        "The same two views: the redder a Gaussian, the more of what was found it"
        f" carries. {record['carrying']:,} of {record['gaussians']:,} carry most of it."
    )
    yield Picture(path=folder / "heat.png", caption=caption, large=True)
    yield from _overdraw(folder, record)
    caption = "The two views that changed most: left the clean file, right this one."
    yield Picture(path=folder / AGAINST, caption=caption, large=True)


def _domes(record: Mapping[str, Any], number: int) -> Iterator[Chart]:
    """Which cameras see which look, and which are covered, on the dome of directions
    above an object's ground.
    """
    item = record["objects"][number]
    up = item["up"] or record.get("up") or (0.0, 0.0, 1.0)
    seen = item["seen_from"]
    count = len(item["looks"])
    middle = "straight above the ground of the object" if item["up"] else "up"
    caption = (
        f"A mark is a camera. The middle is {middle}, a ring is 30 degrees, and azimuth"
        " 0 is the x axis."
    )
    of = f" of object {number + 1}" if len(record["objects"]) > 1 else ""

    def group(
        role: Role, cameras: Iterable[Any]
    ) -> tuple[Role, list[tuple[float, float]]]:
        return role, [angles(camera["direction"], up) for camera in cameras]

    names = ["inside of the directions that explain most"]
    none = "outside"
    what = "colours differ most"
    if item["verdict"] != "nothing found":
        names = [
            f"see look {index + 1}" if count > 1 else "see the look"
            for index in range(count)
        ]
        none = "see none" if count > 1 else "do not see it"
        what = "a look is seen"
    sides = {
        name: group(
            "attack", (camera for camera in seen if index in camera["looks"][:1])
        )
        for index, name in enumerate(names)
    }
    sides[none] = group("control", (camera for camera in seen if not camera["looks"]))
    yield Chart.directions(f"From where {what}{of}", caption, sides)
    if _is_covered(record, item):
        covered = {
            "covered": group(
                "other",
                (camera for camera in seen if camera["blocked"] > LIMITS.blocked),
            ),
            "not covered": group(
                "control",
                (camera for camera in seen if camera["blocked"] <= LIMITS.blocked),
            ),
        }
        yield Chart.directions(f"What covers the object{of}", caption, covered)


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


def _tables(
    record: Mapping[str, Any], looks: Sequence[Mapping[str, Any]]
) -> Iterator[Table]:
    """Each look beside what gloss would explain of it, and what was judged of each
    object.
    """
    explanations: dict[str, Column[Mapping[str, Any]]] = {
        "look": lambda look: (
            f"object {look['object']}"
            + (f", look {look['look'] + 1}" if look["look"] else "")
        ),
        "by direction": lambda look: f"{look['direction']:.4f}",
        "rival: angle of incidence": lambda look: f"{look['incidence']:.4f}",
        "rival: mirrored direction": lambda look: f"{look['mirror']:.4f}",
        "net of gloss": lambda look: f"{look['net']:.5f}",
        "support": lambda look: f"{look['support']:.0%}",
        "cameras that see it": "cameras",
    }
    yield Table.of(
        "How well each explanation fits: what is left when gloss is taken off decides",
        explanations,
        looks,
    )
    objects = [
        {"number": f"object {number}", **item}
        for number, item in enumerate(record["objects"], 1)
    ]
    judged: dict[str, Column[Mapping[str, Any]]] = {
        "object": lambda item: f"{item['number']}, {item['gaussians']:,} Gaussians",
        "verdict": "verdict",
        "middle": lambda item: _numbers(item["centre"]),
        "surface that was judged": lambda item: f"{item['area']:.3g} square units",
        "surface that nothing contradicts": lambda item: (
            f"{item['uncontradicted']:.3g} square units"
        ),
    }
    yield Table.of("What was judged", judged, objects)
    covers: dict[str, Column[Mapping[str, Any]]] = {
        "object": "number",
        "from around": lambda item: _numbers(item["occluder"]["axis"]),
        "of it, cameras elsewhere look through": lambda item: (
            f"{item['occluder']['transparent']:.0%}"
        ),
        "score": lambda item: f"{item['occluder']['score']:.3f}",
    }
    covered = [item for item in objects if _is_covered(record, item)]
    yield Table.of(
        "What covers an object from some directions, while others look through it",
        covers,
        covered,
    )


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


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value + 0.0:.2f}" for value in values)
