"""From where detectors report a study's object: in path-traced pictures, on the clean and on the cloaked splats.

The pictures of the scene as it is are the control of the splats; the clean splat is that of the cloaked one. Rates are
counted by elevation, by azimuth, and in the regions of the attacks, at several confidences; what each detector saw
stays in the ledger of the study.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray

from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.kinds.true_pictures import read_pictures
from attacks.cloak.plots import LABELS, draw_rates, new_axes, save_figure
from attacks.cloak.steps import StudySteps, TrainedSplat
from attacks.cloak.study import STUDY, SUMMARY, differences, whose
from attacks.detectors.base import Detector
from attacks.observe.drawing import annotated
from attacks.observe.look import ON_OBJECT
from attacks.observe.measures import reported
from attacks.observe.rates import Measure, count
from attacks.observe.rows import ATTACKED, CLEAN, DEPTH, DETECTIONS, ROWS, SUFFIX, TRUE, read_rows
from attacks.rate import Rate
from mi_splat.directions import direction_of
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_json, save_png, save_text
from mi_splat.io.images import through_png

CONFIDENCES = (0.1, 0.3, 0.5)
"""From which a detection counts: 0.5 is the study's, 0.3 what many programs take, 0.1 shows what is nearly seen."""
BAND, SECTOR, LOW = 10.0, 30.0, 30.0
"""Degrees of elevation in a band, of azimuth in a sector, and of elevation below which a camera is a low one."""
ELSEWHERE = "outside of all triggers"
VEHICLES = ("car", "truck", "bus")
"""Classes of COCO of which any counts for any."""
PICTURES = (TRUE, CLEAN, ATTACKED)
SHOWN = ((40.0, 8.0), (40.0, 22.0), (40.0, 37.0), (40.0, 52.0), (40.0, 67.0), (40.0, 82.0), (180.0, 10.0))
"""Azimuth and elevation, degrees, near which the cameras of the pictures are."""
DRAWN = (0.3, 0.5)
"""Confidences that plots and pictures show; the lower one is dashed."""
CELL = 192
FILES = (
    "detection-curve.json",
    "detection-curve.md",
    "detection-elevation.png",
    "detection-azimuth.png",
    "contact.png",
)
_OWN, _TARGET = "own", "target"
"""What is reported: the object's class, or any vehicle if it is one; and a class that an attack wants."""
_PICTURE = ("splat", "seed", "detector", "view")


def check_results(study: StudyConfig, results: Path) -> None:
    """Raise unless a folder holds the results of a study.

    Raises:
        InvalidValueError: They are not there, or another study's.
    """
    if not (results / SUMMARY).is_file():
        expected, do = f"a folder with {SUMMARY}, which a finished study has", "run `mi-splat cloak` first"
        raise InvalidValueError(message("--results", expected, str(results), do))
    if others := differences(results / STUDY, study):
        raise InvalidValueError(message("--results", f"a study with {others[0]}", "another", "pass its own results"))


def watch(
    steps: StudySteps, splats: Sequence[TrainedSplat], detectors: Sequence[Detector], *, every: int = 1
) -> pl.DataFrame:
    """Look at the scene and at all splats from held-out cameras, or read what was seen before.

    Args:
        steps: The study.
        splats: Its splats.
        detectors: Those that look.
        every: Each so manieth of the held-out cameras is used.

    Returns:
        A row for each splat (`TRUE` for path-traced pictures), seed, detector and view, with the highest confidences
        `own` and `target` of what is reported on the object.

    Raises:
        InvalidValueError: `every` is not positive.
    """
    if every < 1:
        raise InvalidValueError(message("every", "a positive number", every, "1 uses all cameras"))
    cameras = setup.held_out_cameras(steps.study, steps.mesh_scene.target)[::every]
    true, tables = steps.true_pictures(cameras), list[pl.DataFrame]()
    for splat in (None, *splats):
        job = true if splat is None else steps.splat(splat.splat, splat.seed)
        for detector in detectors:
            seen = "path-traced pictures" if splat is None else f"the {splat.splat} splat, seed {splat.seed}"
            done = steps.do(steps.seen(job, detector, every=every), f"{detector.name} looks at {seen}")
            rows, detections = (whose(read_rows(done.folder / f"{name}{SUFFIX}"), splat) for name in (ROWS, DETECTIONS))
            tables.append(with_scores(steps.study, rows, detections))
    return pl.concat(tables, how="diagonal")


def with_scores(study: StudyConfig, rows: pl.DataFrame, detections: pl.DataFrame) -> pl.DataFrame:
    """Rows with the highest confidence of any of the object's classes, and of any that an attack wants.

    Args:
        study: The study.
        rows: A row for each picture that a detector saw.
        detections: Every detection in them.
    """
    classes = VEHICLES if study.scene.class_name in VEHICLES else (study.scene.class_name,)
    wanted = [attack.target_class for attack in study.attack if attack.target_class is not None]
    on_object = detections.filter(pl.col("iou") >= ON_OBJECT)
    for name, labels in ((_OWN, classes), (_TARGET, wanted)):
        best = on_object.filter(pl.col("label").is_in(labels)).group_by(_PICTURE).agg(pl.col("score").max().alias(name))
        rows = rows.join(best, on=_PICTURE, how="left", nulls_equal=True, maintain_order="left")
    return rows.with_columns(pl.col(_OWN, _TARGET).fill_null(0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Group:
    """Cameras whose rates are taken together.

    Attributes:
        kind: "elevation", "azimuth" or "region".
        name: Of the region; of the others, where the group begins and ends.
        low: Where it begins, degrees; 0 of a region.
        holds: Which rows are of one of them.
    """

    kind: str
    name: str
    low: float
    holds: pl.Expr


def groups(study: StudyConfig) -> list[Group]:
    """Bands of elevation outside of attacks with an azimuth of their own, sectors of low cameras, and regions."""
    elevation, azimuth = pl.col("elevation"), pl.col("azimuth")
    turned = [pl.col(f"{DEPTH}{attack.name}") < 0 for attack in study.attack if attack.azimuth is not None]
    outside = pl.all_horizontal(pl.col(f"{DEPTH}{attack.name}") < 0 for attack in study.attack)
    bands = [BAND * number for number in range(int(90 / BAND))]
    sectors = [SECTOR * number for number in range(int(360 / SECTOR))]

    def group(kind: str, low: float, width: float, *also: pl.Expr) -> Group:
        angle = pl.col(kind)
        holds = pl.all_horizontal(angle >= low, angle < low + width, *also)
        return Group(kind=kind, name=f"{low:g} to {low + width:g}", low=low, holds=holds)

    return [
        *(group("elevation", low, BAND, *turned) for low in bands),
        *(group("azimuth", low, SECTOR, elevation < LOW, azimuth.is_not_null()) for low in sectors),
        *(
            Group(kind="region", name=attack.name, low=0.0, holds=pl.col(f"{DEPTH}{attack.name}") >= 0)
            for attack in study.attack
        ),
        Group(kind="region", name=ELSEWHERE, low=0.0, holds=outside),
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A rate, and what it is of.

    Attributes:
        group: Which cameras.
        detector: Which detector.
        splat: As rows call it, `TRUE` for path-traced pictures.
        seed: Of the splat; None: of all seeds together.
        reported: What counts, "own" or "target".
        confidence: From which it counts.
        rate: How often.
    """

    group: Group
    detector: str
    splat: str
    seed: int | None
    reported: str
    confidence: float
    rate: Rate

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {
            "by": self.group.kind,
            "cameras": self.group.name,
            "detector": self.detector,
            "pictures": LABELS[self.splat],
            "seed": self.seed,
            "reported": self.reported,
            "confidence": self.confidence,
            **self.rate.as_dict(),
        }


def detection_rates(study: StudyConfig, rows: pl.DataFrame) -> list[Line]:
    """Every rate, of all seeds together and of each; of groups in which there is a camera.

    Args:
        study: The study.
        rows: From `watch`.
    """
    questions = [(name, confidence) for name in (_OWN, _TARGET) for confidence in CONFIDENCES]
    lines = []
    for group in groups(study):
        here = rows.filter(group.holds)
        measures = {f"{name} {c}": Measure(holds=reported(name, c)) for name, c in questions}
        together = count(here, measures, ("detector", "splat"))
        single = count(here.filter(pl.col("seed").is_not_null()), measures, ("detector", "splat", "seed"))
        for detector, splat in together:
            alone = {seed: rates for (*whose, seed), rates in single.items() if whose == [detector, splat]}
            for seed, rates in {None: together[detector, splat], **alone}.items():
                for name, confidence in questions:
                    rate = rates[f"{name} {confidence}"]
                    ids = {"detector": detector, "splat": splat, "seed": seed, "reported": name}
                    lines.append(Line(group=group, confidence=confidence, rate=rate, **ids))
    return lines


def chosen(
    lines: Sequence[Line], kind: str, *, detector: str, splat: str, reported: str = _OWN, confidence: float = 0.5
) -> list[tuple[Group, Rate]]:
    """Groups of one kind, in their order, and their rates of all seeds together.

    Args:
        lines: From `detection_rates`.
        kind: Of the groups.
        detector: Which detector.
        splat: Which splat.
        reported: What counts.
        confidence: From which it counts.
    """
    wanted = (kind, detector, splat, None, reported, confidence)
    return [
        (line.group, line.rate)
        for line in lines
        if (line.group.kind, line.detector, line.splat, line.seed, line.reported, line.confidence) == wanted
    ]


def spread(lines: Sequence[Line], like: Line) -> list[Rate]:
    """The rates of single seeds that belong to a rate of all together."""
    same = (like.group, like.detector, like.splat, like.reported, like.confidence)
    return [
        line.rate
        for line in lines
        if line.seed is not None and (line.group, line.detector, line.splat, line.reported, line.confidence) == same
    ]


def write_detection_curve(
    steps: StudySteps,
    rows: pl.DataFrame,
    splats: Sequence[TrainedSplat],
    detectors: Sequence[Detector],
    folder: Path,
    *,
    every: int = 1,
    origin: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write `FILES` and return what is in the JSON one.

    Args:
        steps: The study.
        rows: From `watch`.
        splats: The study's; those of the first seed are shown.
        detectors: Those that looked.
        folder: For the files; it is there.
        every: As in `watch`.
        origin: What else the JSON one shall hold: the study, the flags, versions.

    Raises:
        InvalidValueError: matplotlib is not installed.
        SplatFileError: The folder cannot be written.
    """
    lines = detection_rates(steps.study, rows)
    fingerprints = {detector.name: detector.fingerprint for detector in detectors}
    document = {
        **(origin or {}),
        "cameras": rows["view"].n_unique(),
        "detectors": fingerprints,
        "splats": [{"splat": one.splat, "seed": one.seed, "hash": one.record["hash"]} for one in splats],
        "rates": [line.as_dict() for line in lines],
    }
    for kind, width, label, file in (
        ("elevation", BAND, "elevation of the camera, degrees", FILES[2]),
        ("azimuth", SECTOR, f"azimuth of the camera, degrees; cameras lower than {LOW:g} degrees", FILES[3]),
    ):
        save_figure(_plot(steps, lines, list(fingerprints), kind=kind, half=width / 2, label=label), folder / file)
    save_png(contact_sheet(steps, splats, detectors, every=every), folder / FILES[4])
    save_text(tables(lines, fingerprints), folder / FILES[1])
    save_json(document, folder / FILES[0])
    return document


def tables(lines: Sequence[Line], detectors: Mapping[str, str]) -> str:
    """The rates as Markdown.

    Args:
        lines: From `detection_rates`.
        detectors: Name and fingerprint of each detector.
    """
    fingerprints = ", ".join(f"`{name}` {fingerprint}" for name, fingerprint in detectors.items())
    text = [f"Fingerprints of the weights: {fingerprints}.", ""]
    for kind, title in (
        ("elevation", "By elevation, cameras behind the object left out: the object is reported"),
        ("azimuth", f"By azimuth, cameras lower than {LOW:g} degrees: the object is reported"),
    ):
        text += [title + ", path traced, clean, cloaked", ""]
        for confidence in CONFIDENCES:
            text += _by_group(lines, list(detectors), kind, confidence)
    for name, title in ((_OWN, "the object is reported"), (_TARGET, "the target class is reported")):
        text += [f"In the regions of the attacks: {title}; all seeds, and from the least to the most of a seed", ""]
        for confidence in CONFIDENCES:
            text += _by_region(lines, list(detectors), name, confidence)
    return "\n".join(text)


def _by_group(lines: Sequence[Line], detectors: Sequence[str], kind: str, confidence: float) -> list[str]:
    """A table with a row for each group, and a cell of three rates for each detector."""
    cells: dict[str, list[str]] = {}
    for name in detectors:
        series = [chosen(lines, kind, detector=name, splat=one, confidence=confidence) for one in PICTURES]
        for group in zip(*series, strict=True):
            texts = [f"{rate.successes}/{rate.total}" for _, rate in group]
            cells.setdefault(group[0][0].name, []).append(", ".join(texts))
    head = [f"| {kind}, at {confidence:g} | " + " | ".join(detectors) + " |", "|---" * (len(detectors) + 1) + "|"]
    return [*head, *(f"| {group} | {' | '.join(texts)} |" for group, texts in cells.items()), ""]


def _by_region(lines: Sequence[Line], detectors: Sequence[str], name: str, confidence: float) -> list[str]:
    """A table with a row for each region and detector."""
    titles = [LABELS[splat] for splat in PICTURES]
    text = [f"| region, at {confidence:g} | " + " | ".join(titles) + " |", "|---" * (len(PICTURES) + 1) + "|"]
    wanted = [one for one in lines if (one.group.kind, one.reported, one.confidence) == ("region", name, confidence)]
    for group in dict.fromkeys(line.group.name for line in wanted):
        for detector in detectors:
            here = [one for one in wanted if (one.group.name, one.detector, one.seed) == (group, detector, None)]
            cells = [_with_spread(lines, next(line for line in here if line.splat == splat)) for splat in PICTURES]
            text.append(f"| {group}, {detector} | {' | '.join(cells)} |")
    return [*text, ""]


def _with_spread(lines: Sequence[Line], line: Line) -> str:
    """A rate with its interval, and its least and largest value over the seeds."""
    fractions = [rate.fraction for rate in spread(lines, line)]
    seeds = f"; {min(fractions):.0%} to {max(fractions):.0%}" if len(fractions) > 1 else ""
    return line.rate.words + seeds


def _plot(
    steps: StudySteps, lines: Sequence[Line], detectors: Sequence[str], *, kind: str, half: float, label: str
) -> Any:
    """A panel for each detector with a line for each kind of pictures; dashed at the lower confidence.

    Args:
        steps: The study.
        lines: From `detection_rates`.
        detectors: Their names.
        kind: Of the groups.
        half: Of a group's width, degrees.
        label: Of the axis.
    """
    figure, axes = new_axes(len(detectors), columns=2 if len(detectors) > 1 else 1)
    attack = setup.overhead(steps.study)
    for axis, name in zip(axes, detectors, strict=True):
        for shift, splat in zip((-0.06, 0.0, 0.06), PICTURES, strict=True):
            for confidence in DRAWN:
                points: list[tuple[float, Rate]] = [
                    (group.low + half + 2 * half * shift, rate)
                    for group, rate in chosen(lines, kind, detector=name, splat=splat, confidence=confidence)
                ]
                faint = confidence < max(DRAWN)
                style = {"linestyle": "--", "alpha": 0.45, "label": None, "capsize": 0} if faint else {}
                draw_rates(axis, points, splat, **style)
        if kind == "elevation" and attack is not None:
            axis.axvline(attack.elevation[0], color="#555555", linestyle=":", label="edge of the trigger")
        seen = f"at {DRAWN[1]:g} (dashed {DRAWN[0]:g})"
        axis.set(title=f"{name}: object reported {seen}", xlabel=label, ylabel="fraction", ylim=(-0.03, 1.03))
        axis.legend(fontsize=8)
    return figure


def contact_sheet(
    steps: StudySteps, splats: Sequence[TrainedSplat], detectors: Sequence[Detector], *, every: int = 1
) -> NDArray[np.uint8]:
    """For each detector path traced above clean above cloaked, with what it reports; columns are cameras.

    Args:
        steps: The study.
        splats: The study's; those of the first seed are shown.
        detectors: Those that looked.
        every: As in `watch`.
    """
    study, centre = steps.study, setup.centre_of(steps.study)
    cameras = setup.held_out_cameras(study, steps.mesh_scene.target)[::every]
    true = read_pictures(steps.do(steps.true_pictures(cameras), "taking pictures to compare with").folder)
    directions = [direction_of(camera, centre) for camera in cameras]

    def from_wanted(view: int, azimuth: float, elevation: float) -> float:
        turn = abs((directions[view].azimuth - azimuth + 180) % 360 - 180) * np.cos(np.radians(elevation))
        return float(np.hypot(turn, directions[view].elevation - elevation))

    views = [min(range(len(cameras)), key=lambda view: from_wanted(view, *one)) for one in SHOWN]
    render = steps.renderer()
    pictures = {LABELS[TRUE]: [true.images[view] for view in views]}
    for one in splats:
        if one.seed == study.seeds[0]:
            scene = one.load()
            with torch.no_grad():
                pictures[one.splat] = [through_png(render(scene, cameras[view])) for view in views]
    lines = []
    for detector in detectors:
        for which, images in pictures.items():
            with torch.no_grad():
                reports = detector.detect(torch.stack(images))
            titles = [f"{which}, {directions[view].elevation:.0f} deg up" for view in views]
            titles[0] = f"{detector.name}: {which}"
            cells = [
                annotated(image, report, title, min_confidence=DRAWN[0], width=CELL)
                for image, report, title in zip(images, reports, titles, strict=True)
            ]
            lines.append(np.concatenate(cells, axis=1))
    return np.concatenate(lines)
