"""Where detectors find a study's object: path traced, on the clean splats, and on the cloaked ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from attacks.rate import Rate, percent
from attacks.report.section import Chart, Figure, Line, Picture, Point, Role, Section
from attacks.report.stories.experiments import Document, Row, matching
from attacks.report.wording import listed, plural, pooled
from attacks.tables import Table, cell

CONFIDENCE = 0.5
"""From which an object counts as found, as in the studies."""
PICTURES: Mapping[str, Role] = {"cloaked": "attack", "clean": "control", "path traced": "other"}
ELSEWHERE = "outside of all triggers"
"""Name of the region without triggers."""


def read(folder: Path, found: Document) -> Section:
    """The section of a folder with detection-curve.json.

    Args:
        folder: Where it lies.
        found: Its detection-curve.json.
    """
    rows: Sequence[Row] = found["rates"]
    names, region = list(found["detectors"]), _hiding(found)
    rate, control, true = (_missed(rows, region, pictures) for pictures in PICTURES)
    seeds = len({one["seed"] for one in found["splats"]})
    return Section(
        title="",
        kind="CLOAK, from where the object is found",
        done=(
            f"{listed(names)} looked from {plural(found['cameras'], 'held-out camera')} at the path-traced object, at "
            f"the clean splats and at the cloaked ones ({plural(seeds, 'seed')}). The path-traced pictures say what a "
            "detector sees of the object itself."
        ),
        conclusion=(
            f"In the region {region} the object is missed in {rate.counts} looks at the cloaked splats, in "
            f"{control.counts} at the clean ones, and in {true.counts} at the path-traced object, over all "
            "detectors. A detector that misses the object itself says nothing of the attack: look at each."
        ),
        headline=Figure(label=f"cloaked splats: object missed in the region {region}", rate=rate, note="all detectors"),
        control=Figure(label="clean splats: object missed there", rate=control) if control.total else None,
        figures=[
            Figure(label="path traced: object missed there", rate=true),
            *(
                Figure(
                    label=f"{name}, cloaked splats: object missed there", rate=_missed(rows, region, "cloaked", name)
                )
                for name in names
            ),
        ],
        warnings=[*_doubts(rows, names, region, seeds)],
        pictures=_pictures(folder),
        charts=tuple(_charts(rows, names)),
        tables=tuple(_tables(rows, names)),
    )


def _hiding(found: Document) -> str:
    """The region from which the object is to be missed: of the attack from all around, or else the first one."""
    attacks = found.get("configuration", {}).get("attack", [])
    named = next((str(one["name"]) for one in attacks if one["azimuth"] is None), None)
    regions = [str(row["cameras"]) for row in found["rates"] if row["by"] == "region" and row["cameras"] != ELSEWHERE]
    if named is None and not regions:
        raise KeyError("a region of an attack")
    return named or regions[0]


def _missed(rows: Sequence[Row], region: str, pictures: str, detector: str | None = None) -> Rate:
    own = matching(
        rows, by="region", cameras=region, pictures=pictures, seed=None, reported="own", confidence=CONFIDENCE
    )
    rate = pooled(Rate.of(row) for row in own if detector in (None, row["detector"]))
    return Rate(successes=rate.total - rate.successes, total=rate.total)


def _doubts(rows: Sequence[Row], names: Sequence[str], region: str, seeds: int) -> Iterator[str]:
    if seeds == 1:
        yield "One seed: another training may give another rate"
    for name in names:
        clean = _missed(rows, region, "clean", name)
        if clean.total and clean.fraction > 0.5:
            seen = f"{name} misses the clean object in {clean.counts} views of the region {region}"
            yield f"{seen}: that it misses the cloaked one there says little"


def _pictures(folder: Path) -> tuple[Picture, ...]:
    return (
        Picture(
            path=folder / "contact.png",
            caption="For each detector: path traced, clean and cloaked, with what it reports.",
            alt="Pictures of the object in rows, with boxes",
            wide=True,
        ),
    )


def _charts(rows: Sequence[Row], names: Sequence[str]) -> Iterator[Chart]:
    for name in names:
        for kind, words in (("elevation", "elevation"), ("azimuth", "azimuth, low cameras")):
            own = matching(rows, by=kind, detector=name, seed=None, reported="own", confidence=CONFIDENCE)
            lines = []
            for pictures, role in PICTURES.items():
                points = tuple(Point.of(_middle(row), Rate.of(row)) for row in matching(own, pictures=pictures))
                lines.append(Line(name=pictures, role=role, points=points))
            if any(line.points for line in lines):
                yield Chart(
                    title=f"Found by {name}, by {words}",
                    caption=f"From a confidence of {CONFIDENCE:g}; bands are 95 % intervals.",
                    x_label=f"{kind} of the camera, degrees",
                    y_label="views in which it is found",
                    lines=tuple(lines),
                )


def _middle(row: Row) -> float:
    low, high = str(row["cameras"]).split(" to ")
    return (float(low) + float(high)) / 2


def _tables(rows: Sequence[Row], names: Sequence[str]) -> Iterator[Table]:
    """The regions of the attacks: what is reported there, by detector."""
    for reported, title in (("own", "The object is reported"), ("target", "The target class is reported")):
        for confidence in dict.fromkeys(row["confidence"] for row in rows):
            own = matching(rows, by="region", reported=reported, confidence=confidence)
            cells = []
            for region in dict.fromkeys(str(row["cameras"]) for row in own):
                for name in names:
                    here = matching(own, cameras=region, detector=name)
                    cells.append((region, name, *(_cell(here, pictures) for pictures in PICTURES)))
            if cells:
                head = ("region", "detector", *PICTURES)
                yield Table(caption=f"{title}, from a confidence of {confidence:g}", head=head, rows=tuple(cells))


def _cell(rows: Sequence[Row], pictures: str) -> str:
    """All seeds together, and the least and the most of a single one."""
    together = next((Rate.of(row) for row in matching(rows, pictures=pictures, seed=None)), None)
    seeds = [Rate.of(row).fraction for row in rows if row["pictures"] == pictures and row["seed"] is not None]
    spread = f"; by seed {percent(min(seeds))} to {percent(max(seeds))}" if len(seeds) > 1 else ""
    return cell(together) + spread
