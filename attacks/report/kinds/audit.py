"""What `mi-splat audit` leaves behind: whether a splat shows something from some directions only."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from attacks.audits.disagreement import Seen
from attacks.report.section import Chart, Figure, Line, Picture, Point, Role, Section, plural, sentence, settings
from attacks.tables import Table
from mi_splat.audit.files import AGAINST
from mi_splat.audit.results import Vector
from mi_splat.audit.thresholds import LIMITS

_ELSEWHERE = (
    *("story", "file", "verdict", "summary", "objects", "pictures", "cameras", "views", "lint", "cost", "against"),
    "pictures_in_set",
    *("command", "versions", "variant", "commit", "torch"),
)
_PLAIN = {
    "hidden look": (
        "This file hides something: an object has other colours from some directions than from all others, and no "
        "gloss explains it. Look at the two pictures."
    ),
    "suspicious": (
        "This file is suspicious, which proves nothing: look at the pictures and at the directions before you trust it."
    ),
    "nothing found": "No hidden look was found. This does not say that the file is safe: see what was not judged.",
}


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of an audit."""
    objects, findings = record["objects"], record.get("lint") or ()
    shared: dict[str, Any] = {
        "title": Path(record["file"]).name,
        "attacked": False,
        "configuration": settings({key: value for key, value in record.items() if key not in _ELSEWHERE}),
    }
    if not objects:  # lint alone was asked for, or there was nothing to look at
        errors = [row for row in findings if row["severity"] == "error"]
        return Section(
            **shared,
            kind="audit of a splat",
            done=f"The numbers of {record['file']} were checked; it was {record['summary'][0]}.",
            conclusion=(
                "Whether the file hides a look was not looked at. The rules found "
                f"{plural(len(errors), 'error')} and {plural(len(findings) - len(errors), 'lesser thing')}."
            ),
            headline=Figure(label="errors in the numbers", words=str(len(errors))),
            warnings=[f"{row['rule']}: {row['reason']}" for row in errors],
            pictures=tuple(_overdraw(folder, record)),
            tables=(_lint(findings),),
        )
    looks = [
        (number, index, look) for number, item in enumerate(objects, 1) for index, look in enumerate(item["looks"])
    ]
    views, thresholds = record.get("views") or (), record["thresholds"]
    excess = max(look["excess"] for _, _, look in looks)
    contradicting = [view for view in views if view["contradicts"]]
    carried = (
        Figure(label="pictures that show what others contradict", words=f"{len(contradicting)} of {len(views)}")
        if views
        else Figure(label="Gaussians that carry it", words=f"{record['carrying']:,} of {record['gaussians']:,}")
    )
    return Section(
        **shared,
        kind="audit of pictures" if views else "audit of a splat",
        done=_done(record),
        conclusion=f"{_PLAIN[record['verdict']]} {sentence(record['summary'][0].partition(': ')[2])}",
        headline=Figure(
            label="verdict",
            words=record["verdict"],
            note=f"excess {excess:.4f}; hidden from {thresholds['excess']:g}",
        ),
        figures=(
            carried,
            Figure(label="solid Gaussians near an object that was looked at", words=f"{record['near']:.0%}"),
        ),
        warnings=tuple(_doubts(record)),
        pictures=tuple(_pictures(folder, record)),
        charts=tuple(chart for number in range(len(objects)) for chart in _domes(record, number)),
        tables=(*_tables(record, looks), _lint(findings), _changes(record.get("against") or {})),
    )


def _overdraw(folder: Path, record: Mapping[str, Any]) -> Iterator[Picture]:
    """What the splat costs from the worst camera."""
    cost = record.get("cost") or {}
    if worst := cost.get("overdraw"):
        caption = (
            f"How many Gaussians lie over each other from the worst of {plural(worst['cameras'], 'camera')}: "
            f"{worst['mean']:,.0f} in the mean, {worst['highest']:,} at most. The fillRatio of splat-transform is "
            f"{cost['fill_ratio']:.3g}."
        )
        yield Picture(path=folder / "overdraw.png", caption=caption, large=True)


def _done(record: Mapping[str, Any]) -> str:
    """What was looked at, and how."""
    objects, views = record["objects"], record.get("views") or ()
    many = f"{plural(len(objects), 'object')} {'was' if len(objects) == 1 else 'were'}"
    how = (
        "For each set of directions the colours of the same surface from inside and from outside were compared, and "
        "what honest gloss explains was taken off."
    )
    if views:
        return (
            f"A small splat was trained on {plural(len(views), 'picture')} of {record['file']} to know where the "
            f"surface is, and {many} judged by the pictures alone. {how}"
        )
    cameras = plural(sum(len(item["seen_from"]) for item in objects), "direction")
    return f"In {record['file']} ({record['gaussians']:,} Gaussians) {many} looked at from {cameras}. {how}"


def _doubts(record: Mapping[str, Any]) -> Iterator[str]:
    """What the reader may not conclude."""
    for number, item in enumerate(record["objects"], 1):
        share = item["uncontradicted"] / max(item["uncontradicted"] + item["area"], 1e-12)
        if share >= 0.005:
            yield (
                f"Object {number}: {share:.0%} of the surface that shows is seen from one side or by few cameras. What "
                "is shown there is not contradicted by anything, so nothing can be said of it"
            )
        cover = item["occluder"]
        if cover is not None and cover["score"] >= record["thresholds"]["covered"]:
            yield (
                f"Object {number}: something in the air covers it from around ({_numbers(cover['axis'])}), and other "
                "cameras look through it. An honest canopy may do the same"
            )
        edit = item.get("edited")
        if edit and edit["score"] >= 1:
            camera = f", aimed at a camera towards ({_numbers(edit['camera'])})" if edit["camera"] else ""
            yield (
                f"Object {number}: its colours have shades that neither paint nor light explains{camera}. An attack on "
                "a detector leaves such; a training by photographs does not"
            )
    compared = len(record.get("views") or ())
    if compared < record.get("pictures_in_set", compared):
        yield f"{compared} of the {record['pictures_in_set']} pictures were compared: nothing is said of the others"
    if record["near"] < 0.995:
        yield (
            f"{1 - record['near']:.0%} of the solid Gaussians lie far from every object that was looked at: nothing is "
            "said of them"
        )
    for row in record.get("lint") or ():
        if row["severity"] == "error":
            count = f" ({plural(row['count'], 'Gaussian')})" if row["count"] else ""
            yield f"{row['rule']}: {row['reason']}{count}"


def _pictures(folder: Path, record: Mapping[str, Any]) -> Iterator[Picture]:
    """The pairs that prove looks, the heat, and what changed since a clean file."""
    thresholds = record["thresholds"]
    for shown in record["pictures"]:
        looks = record["objects"][shown["object"]]["looks"]
        name = f"Object {shown['object'] + 1}" + (f", look {shown['look'] + 1}" if len(looks) > 1 else "")
        proven = looks[shown["look"]]["excess"] / thresholds["excess"] >= thresholds["suspicion"]
        caption = (
            f"{name}: the same surface, left from inside of the directions from which "
            f"{'the look shows' if proven else 'colours differ most'}, right from outside. The surface that both see "
            f"differs by {shown['change']:.2f} in the mean (sRGB, 0 to 1)."
        )
        yield Picture(path=folder / Path(shown["file"]).name, caption=caption, large=True)
    caption = (
        "The same two views: the redder a Gaussian, the more of what was found it carries. "
        f"{record['carrying']:,} of {record['gaussians']:,} carry most of it."
    )
    yield Picture(path=folder / "heat.png", caption=caption, large=True)
    yield from _overdraw(folder, record)
    caption = "The two views that changed most: left the clean file, right this one."
    yield Picture(path=folder / AGAINST, caption=caption, large=True)


def _domes(record: Mapping[str, Any], number: int) -> Iterator[Chart]:
    """Which cameras see which look, and which are covered, on the dome of directions above an object's ground."""
    item = record["objects"][number]
    up, seen, count = item["up"] or record.get("up") or (0.0, 0.0, 1.0), item["seen_from"], len(item["looks"])
    middle = "straight above the ground of the object" if item["up"] else "up"
    caption = f"A mark is a camera. The middle is {middle}, a ring is 30 degrees, and azimuth 0 is the x axis."
    of = f" of object {number + 1}" if len(record["objects"]) > 1 else ""

    def group(role: Role, cameras: Iterable[Any]) -> tuple[Role, list[tuple[float, float]]]:
        return role, [angles(camera["direction"], up) for camera in cameras]

    suspicious = item["verdict"] != "nothing found"
    none = ("see none" if count > 1 else "do not see it") if suspicious else "outside"
    names = [f"see look {index + 1}" if count > 1 else "see the look" for index in range(count)]
    sides = {
        name: group("attack", (camera for camera in seen if index in camera["looks"][:1]))
        for index, name in enumerate(names if suspicious else ["inside of the directions that explain most"])
    }
    sides[none] = group("control", (camera for camera in seen if not camera["looks"]))
    what = "a look is seen" if suspicious else "colours differ most"
    yield Chart.directions(f"From where {what}{of}", caption, sides)
    if item["occluder"] is not None and item["occluder"]["score"] >= record["thresholds"]["covered"]:
        covered = {
            "covered": group("other", (camera for camera in seen if camera["blocked"] > LIMITS.blocked)),
            "not covered": group("control", (camera for camera in seen if camera["blocked"] <= LIMITS.blocked)),
        }
        yield Chart.directions(f"What covers the object{of}", caption, covered)


def angles(direction: Vector, up: Vector) -> tuple[float, float]:
    """Azimuth from the file's x axis and elevation above the ground of an object, degrees."""
    start = (1.0, 0.0, 0.0) if abs(up[0]) < 0.9 else (0.0, 1.0, 0.0)
    height = _dot(direction, up)
    east = [a - _dot(start, up) * b for a, b in zip(start, up, strict=True)]
    north = [up[(i + 1) % 3] * east[(i + 2) % 3] - up[(i + 2) % 3] * east[(i + 1) % 3] for i in range(3)]
    azimuth = math.degrees(math.atan2(_dot(direction, north), _dot(direction, east))) % 360
    return round(azimuth, 1), round(math.degrees(math.asin(max(-1.0, min(1.0, height)))), 1)


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return math.fsum(x * y for x, y in zip(a, b, strict=True))


def _tables(record: Mapping[str, Any], looks: Sequence[tuple[int, int, Mapping[str, Any]]]) -> Iterator[Table]:
    """Each look beside what gloss would explain of it, and what was judged of each object."""
    yield Table.of(
        "How well each explanation fits: what is left when gloss is taken off decides",
        {
            "look": lambda row: f"object {row[0]}" + (f", look {row[1] + 1}" if row[1] else ""),
            "by direction": lambda row: f"{row[2]['score']:.4f}",
            "rival: angle of incidence": lambda row: f"{row[2]['incidence']:.4f}",
            "rival: mirrored direction": lambda row: f"{row[2]['mirror']:.4f}",
            "common to faces that look different ways": lambda row: f"{row[2]['shift']:.4f}",
            "contrast that is lost": lambda row: f"{row[2]['fade']:.0%}",
            "excess": lambda row: f"{row[2]['excess']:.4f}",
            "cameras that see it": lambda row: str(row[2]["cameras"]),
        },
        looks,
    )
    objects, least = list(enumerate(record["objects"], 1)), record["thresholds"]["covered"]
    yield Table.of(
        "What was judged",
        {
            "object": lambda row: f"object {row[0]}, {row[1]['gaussians']:,} Gaussians",
            "verdict": lambda row: row[1]["verdict"],
            "middle": lambda row: _numbers(row[1]["centre"]),
            "surface that was judged": lambda row: f"{row[1]['area']:.3g} square units",
            "surface that nothing contradicts": lambda row: f"{row[1]['uncontradicted']:.3g} square units",
        },
        objects,
    )
    yield Table.of(
        "What covers an object from some directions, while others look through it",
        {
            "object": lambda row: f"object {row[0]}",
            "from around": lambda row: _numbers(row[1]["occluder"]["axis"]),
            "of it, cameras elsewhere look through": lambda row: f"{row[1]['occluder']['transparent']:.0%}",
            "score": lambda row: f"{row[1]['occluder']['score']:.3f}",
        },
        [row for row in objects if row[1]["occluder"] and row[1]["occluder"]["score"] >= least],
    )
    yield Table.of(
        "Pictures that show what others contradict",
        {"picture": "picture", "amount of the look (0 none, 1 all)": lambda view: f"{view['amount']:.2f}"},
        [view for view in record.get("views") or () if view["contradicts"]],
    )


def _lint(findings: Sequence[Mapping[str, Any]]) -> Table:
    """What rules about numbers have found."""
    return Table.of(
        "What is wrong with the numbers of the file",
        {
            "rule": "rule",
            "severity": "severity",
            "Gaussians": lambda row: f"{row['count']:,}" if row["count"] else "the whole file",
            "why it matters": "reason",
        },
        findings,
    )


def _changes(against: Mapping[str, Any]) -> Table:
    """What changed since a clean file."""
    return Table.of(
        f"What changed since the clean file, over {against.get('gaussians', 0):,} Gaussians",
        {
            "attribute": "attribute",
            "Gaussians that changed": lambda row: f"{row['count']:,}",
            "median change": lambda row: f"{row['median']:.3g}",
            "largest": lambda row: f"{row['most']:.3g}",
            "unit": "unit",
            "distance of the distributions, standard deviations": lambda row: f"{row['distribution']:.3g}",
        },
        against.get("attributes", ()),
    )


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value + 0.0:.2f}" for value in values)


def along_paths(section: Section, seen: Iterable[Seen]) -> Section:
    """The section of an audit with what detectors report along paths of cameras: evidence, and no rule."""
    paths = list(seen)
    return replace(
        section,
        charts=(*section.charts, *map(_along, paths)),
        tables=(
            *section.tables,
            Table.of(
                "Along paths of cameras",
                {
                    "object": "number",
                    "path": "path",
                    "detector": "detector",
                    "what is reported, in order": "runs",
                    "changes and comes back": "comes_back",
                },
                [
                    {
                        **{"number": seen_path.number, "path": seen_path.path, "detector": seen_path.detector},
                        **{"runs": ", ".join(seen_path.runs), "comes_back": seen_path.comes_back},
                    }
                    for seen_path in paths
                ],
            ),
        ),
    )


def _along(seen: Seen) -> Chart:
    """The class with most confidence at each place of a path."""
    points = list(zip(seen.degrees, seen.labels, seen.scores, strict=True))
    return Chart(
        title=f"Object {seen.number}: {seen.detector} {seen.path}",
        x_label="degrees along the path",
        y_label="confidence",
        caption="Where no point is, nothing is reported on the object from a confidence of 0.5 on. No rule follows.",
        lines=tuple(
            Line(name=label, role="other", points=tuple(Point(x, score) for x, at, score in points if at == label))
            for label in dict.fromkeys(label for label in seen.labels if label is not None)
        ),
        connected=False,
    )
