"""Detectors on labelled pictures: rows for what they report on each object, and the figures that are counted from them.

A detection is right if it overlaps an object of its class that no more confident one has taken, by `ON_OBJECT` or more.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl
import torch
from torch import Tensor

from attacks.detectors.base import Detections, Detector
from attacks.detectors.catalogue import SMALL_CLASSES, DetectorError
from attacks.detectors.registry import load_detector
from attacks.detectors.training.config import EMPTY, PATH_TRACED, SPLAT_RENDERS
from attacks.detectors.training.pictures import LabelledPicture, viewing_conditions
from attacks.gaussian_subset import GaussianSubset
from attacks.observe.look import ON_OBJECT, Looked, detection_cells
from attacks.observe.rates import Measure, count
from attacks.observe.rows import BOX, DETECTIONS, ROWS, Cell, Row, frame_with
from attacks.observe.views import visible_box, visible_weight
from attacks.rate import Rate
from mi_splat.io.images import to_bytes
from mi_splat.rendering import Renderer
from mi_splat.scene_files import open_scene

WITH_OBJECTS = (PATH_TRACED, SPLAT_RENDERS)
MIN_CONFIDENCE = 0.001
"""Confidence of detections that count in an average precision, of detectors whose floor can be chosen.

The floor of 0.25 that ultralytics' detectors have otherwise would cut the curve off.
"""
EQUAL = (0.01, 0.1, 1.0)
"""False positives per picture at which detectors are equally strict."""
_BATCH = 16
_LUMA = (0.2126, 0.7152, 0.0722)
_IDS = ("condition", "detector", "view", "object")


class Condition(NamedTuple):
    """How an object is seen.

    Attributes:
        unit: Of its values.
        edges: Of the bins in which recall is given.
    """

    unit: str
    edges: tuple[float, ...]


CONDITIONS = {
    "elevation": Condition("degrees", (0, 15, 30, 45, 60, 75, 90)),
    "distance": Condition("diagonals of the object", (0, 1.5, 2.5, 4, 6, math.inf)),
    "size": Condition("of the picture's side", (0, 0.2, 0.35, 0.5, 0.75, 1)),
    "brightness": Condition("mean luma", (0, 0.2, 0.3, 0.4, 1)),
    "sun_elevation": Condition("degrees", (0, 30, 45, 60, 90)),
    "sun_strength": Condition("irradiance", (0, 0.5, 1.5, 2.5, math.inf)),
}
"""How an object is seen.

elevation: above the horizontal plane, of the camera as seen from the object; an object that is seen from below is in no
bin. distance: from the camera to the object, in diagonals of the object's box in the world. size: longer side of the
box in the picture. brightness: mean luma (Rec. 709 weights on sRGB values) of the picture in that box; it counts the
shade that an object stands in, and its own colour. sun_elevation: above the horizon. sun_strength: irradiance of the
sun on a surface that faces it, 0 under a closed cover of clouds; rooms stand under the same sun, behind walls.
"""


def load_for_evaluation(name: str, weights: Path | None = None) -> Detector:
    """A detector of the project's classes that keeps its unlikely detections too, as an average precision needs them.

    Where `min_confidence` is an attribute of the detector it is lowered; others keep theirs, 0.05 for most.
    """
    detector: Any = load_detector(name, weights=weights)
    if lacking(detector) == SMALL_CLASSES:
        expected, do = f"one that knows some of {', '.join(SMALL_CLASSES)}", "choose another detector"
        raise DetectorError.of(f"detector {name}", expected, "one that knows none", do)
    if "min_confidence" in getattr(detector, "__dict__", {}):
        detector.min_confidence = MIN_CONFIDENCE
    return detector  # type: ignore[no-any-return]


def lacking(detector: Detector) -> tuple[str, ...]:
    """The project's classes that a detector does not know."""
    return tuple(label for label in SMALL_CLASSES if label not in detector.classes)


def splat_scene_pictures(path: Path) -> list[LabelledPicture]:
    """A splat scene XML from each of its cameras at 8 bits; shapes whose id is a class (or stop_sign) are objects."""
    loaded = open_scene(path)
    render, pictures = Renderer(loaded.settings), []
    for camera in loaded.cameras.values():
        with torch.no_grad():
            image = torch.from_numpy(to_bytes(render(loaded.scene, camera)))
        boxes, labels, conditions = [torch.zeros(0, 4)], [], []
        for number, name in enumerate(SMALL_CLASSES, start=1):
            mask = loaded.objects.get(name, loaded.objects.get(name.replace(" ", "_")))
            if mask is None:
                continue
            box = visible_box(visible_weight(GaussianSubset.of(loaded.scene, mask), camera, render))
            if box is not None:
                boxes.append(box[None])
                labels.append(number)
                conditions.append(viewing_conditions(loaded.scene.means[mask].numpy(), camera))
        numbers = torch.tensor(labels, dtype=torch.int64)
        pictures.append(LabelledPicture(image, torch.cat(boxes), numbers, tuple(conditions)))
    return pictures


def look_at(detector: Detector, sets: Mapping[str, Sequence[LabelledPicture]]) -> Looked:
    """Let a detector look at sets of pictures, each of one size; views are numbered through all of them.

    A row is one object of a class that the detector knows, a row of the detections one of these, whatever its
    confidence. A detection belongs to the object that it matches, or else to the one that it overlaps most.

    Args:
        detector: Knows some of the project's classes, and others if it likes.
        sets: Pictures by the name of their set, which is the `condition` of the rows.

    Returns:
        Rows of objects and of detections.
    """
    rows, detections, view = list[Row](), list[Row](), 0
    known = {number for number, label in enumerate(SMALL_CLASSES, start=1) if label in detector.classes}
    for name, pictures in sets.items():
        for start in range(0, len(pictures), _BATCH):
            part = pictures[start : start + _BATCH]
            results = detector.detect(torch.stack([picture.image for picture in part]).float() / 255)
            for picture, result in zip(part, results, strict=True):
                ids: dict[str, Cell] = {"condition": name, "detector": detector.name, "view": view}
                seen = _detections(ids, result, picture)
                shown = [number for number, label in enumerate(picture.labels.tolist()) if label in known]
                rows += [_object_row(ids, picture, number, seen) for number in shown]
                detections += seen
                view += 1
    columns = (*_IDS, *BOX, "elevation", "distance", "extent", "original", "label", "score", "original_score")
    return Looked(
        rows=frame_with(rows, (*columns, "size", "brightness", "sun_elevation", "sun_strength")),
        detections=frame_with(detections, (*_IDS, "label", "score", "iou")),
    )


def _detections(ids: Mapping[str, Cell], result: Detections, picture: LabelledPicture) -> list[Row]:
    """Rows of the detections in a picture; the most confident ones choose their objects first."""
    from torchvision.ops import box_iou  # takes a second to import, and reports of results do without

    labels = [SMALL_CLASSES[label - 1] for label in picture.labels.tolist()]
    iou: list[list[float]] = box_iou(result.boxes.cpu(), picture.boxes).tolist()
    owners = [max(range(len(labels)), key=shared.__getitem__, default=None) for shared in iou]
    taken = set[int]()
    for row in torch.argsort(result.scores.cpu(), descending=True, stable=True).tolist():
        free = [index for index, label in enumerate(labels) if label == result.labels[row] and index not in taken]
        best = max(free, key=iou[row].__getitem__, default=None)
        if best is not None and iou[row][best] >= ON_OBJECT:
            owners[row] = best
            taken.add(best)
    return [
        {**ids, "object": owner, **detection_cells(result, row, None if owner is None else iou[row][owner])}
        for row, owner in enumerate(owners)
    ]


def _object_row(ids: Mapping[str, Cell], picture: LabelledPicture, number: int, detections: Sequence[Row]) -> Row:
    """What is reported on an object of a picture, and how it is seen."""
    label, box = SMALL_CLASSES[int(picture.labels[number]) - 1], picture.boxes[number].tolist()
    x0, y0, x1, y1 = map(round, box)
    inside = picture.image[y0:y1, x0:x1].float() / 255
    on_object = [row for row in detections if row["object"] == number and float(row["iou"] or 0) >= ON_OBJECT]
    best = max(on_object, key=lambda row: float(row["score"] or 0), default={"label": None, "score": 0.0})
    scores = [float(row["score"] or 0) for row in on_object if row["label"] == label]
    seen: dict[str, Cell] = {}
    if picture.conditions:
        how = picture.conditions[number]
        seen = {"elevation": how.elevation, "distance": how.distance, "extent": how.extent}
        seen |= {"sun_elevation": how.sun_elevation, "sun_strength": how.sun_strength}
    return {
        **ids,
        "object": number,
        **dict(zip(BOX, box, strict=True)),
        "original": label,
        "label": best["label"],
        "score": best["score"],
        "original_score": max(scores, default=0.0),
        "size": max(x1 - x0, y1 - y0) / max(picture.image.shape[:2]),
        "brightness": float((inside @ torch.tensor(_LUMA)).mean()) if inside.numel() else None,
        **seen,
    }


def figures(record: Mapping[str, Any], tables: Mapping[str, pl.DataFrame]) -> dict[str, Any]:
    """Every figure of an evaluation, of its rows."""
    by_detector = {}
    for name in record["detectors"]:
        rows, detections = (tables[table].filter(detector=name) for table in (ROWS, DETECTIONS))
        by_detector[name] = detector_figures(rows, detections, record["sets"], record["confidence"])
    return {"detectors": by_detector}


def detector_figures(
    rows: pl.DataFrame, detections: pl.DataFrame, sets: Mapping[str, int], confidence: float
) -> dict[str, Any]:
    """The figures of one detector: of each set, and its false positives in those with and without objects together.

    `confidence_at` says from which confidence there are so many false positives per picture: rates that count from
    there compare detectors that are equally strict.
    """
    judged = with_right(rows, detections)
    together = {
        "with objects": [name for name in sets if name in WITH_OBJECTS],
        "without objects": [name for name in sets if name.startswith(EMPTY)],
    }
    totals = {}
    for name, members in {**together, "all": [member for part in together.values() for member in part]}.items():
        part, pictures = judged.filter(pl.col("condition").is_in(members)), sum(sets[member] for member in members)
        if pictures:
            at = confidences_at(_wrong(part)["score"].to_list(), pictures)
            totals[name] = {**false_positives(part, pictures, confidence), "confidence_at": at}
    of_sets = {
        name: set_figures(rows.filter(condition=name), judged.filter(condition=name), pictures, confidence)
        for name, pictures in sets.items()
    }
    return {"sets": of_sets, "false_positives": totals}


def with_right(rows: pl.DataFrame, detections: pl.DataFrame) -> pl.DataFrame:
    """Detections with the class of their object, `original`, and whether they are `right`."""
    objects = rows.select("view", "object", "original")
    fits = (pl.col("label") == pl.col("original")) & (pl.col("iou") >= ON_OBJECT)
    rank = pl.when(fits).then("score").rank("ordinal", descending=True).over("view", "object")
    joined = detections.join(objects, on=("view", "object"), how="left", maintain_order="left")
    return joined.with_columns(right=(fits & (rank == 1)).fill_null(value=False))


def set_figures(rows: pl.DataFrame, judged: pl.DataFrame, pictures: int, confidence: float) -> dict[str, Any]:
    """Every figure of one set as JSON can hold it; average precision and recall only where there are objects."""
    likely = judged.filter(pl.col("score") >= confidence)
    others = likely.filter(~pl.col("label").is_in(SMALL_CLASSES))["label"].to_list()
    wrong = false_positives(judged, pictures, confidence)
    values = {"pictures": pictures, "false_positives": wrong, "other_classes": _frequencies(others)}
    if not len(rows):
        return values
    is_reported = Measure(holds=pl.col("original_score") >= confidence)
    rates = {label: rate["rate"] for (label,), rate in count(rows, {"rate": is_reported}, ("original",)).items()}
    rates = {label: rates[label] for label in SMALL_CLASSES if label in rates}
    parts = {label: judged.filter(label=label) for label in rates}
    ap = {
        label: average_precision(torch.tensor(part["score"]), torch.tensor(part["right"]), rates[label].total)
        for label, part in parts.items()
    }
    return {
        **values,
        "ap": ap,
        "map": sum(ap.values()) / len(ap),
        "found": {label: rate.as_dict() for label, rate in rates.items()},
        "found_by": {name: bins for name in CONDITIONS if (bins := _by_condition(rows, name, is_reported))},
        "reported_as": _reported_as(rows, likely),
    }


def _by_condition(rows: pl.DataFrame, name: str, measure: Measure) -> dict[str, list[dict[str, Any]]]:
    """A rate in the bins of a condition, of all objects and of cars; a bin has its lower edge, the last one both."""
    edges = CONDITIONS[name].edges
    value = pl.col("distance") / pl.col("extent") if name == "distance" else pl.col(name)
    bins = {}
    for group, part in (("all", rows), ("car", rows.filter(original="car"))):
        known = part.filter(value.is_not_null())
        measures = {
            str(low): Measure(
                holds=measure.holds, given=value.is_between(low, high, closed="both" if high == edges[-1] else "left")
            )
            for low, high in pairwise(edges)
        }
        if len(known):
            rates = count(known, measures)[()].values()
            ends = ((low, high if math.isfinite(high) else None) for low, high in pairwise(edges))
            bins[group] = [
                {"from": low, "to": high, **rate.as_dict()} for (low, high), rate in zip(ends, rates, strict=True)
            ]
    return bins


def _reported_as(rows: pl.DataFrame, likely: pl.DataFrame) -> dict[str, dict[str, int]]:
    """Class of the objects to what else is reported on them, to the number of objects; the most frequent first."""
    others = likely.filter((pl.col("iou") >= ON_OBJECT) & (pl.col("label") != pl.col("original")))
    others = others.unique(("view", "object", "label"), maintain_order=True)
    labels = dict.fromkeys(rows["original"])
    named = {label: _frequencies(others.filter(original=label)["label"].to_list()) for label in labels}
    return {label: counts for label, counts in named.items() if counts}


def _frequencies(labels: Sequence[str]) -> dict[str, int]:
    """How often each label occurs; the most frequent first."""
    return {
        label: labels.count(label) for label in sorted(set(labels), key=lambda label: (-labels.count(label), label))
    }


def average_precision(scores: Tensor, right: Tensor, objects: int) -> float:
    """Area under the precision-recall curve, precision made monotonous (all-point interpolation of PASCAL VOC 2010)."""
    hits = right[torch.argsort(scores, descending=True, stable=True)].double()
    precision = hits.cumsum(0) / torch.arange(1, len(hits) + 1)
    best_later = precision.flip(0).cummax(0).values.flip(0)
    return float((best_later * hits).sum() / objects)


def _wrong(judged: pl.DataFrame) -> pl.DataFrame:
    return judged.filter(~pl.col("right") & pl.col("label").is_in(SMALL_CLASSES))


def false_positives(judged: pl.DataFrame, pictures: int, confidence: float) -> dict[str, Any]:
    """False positives as JSON can hold them; there must be pictures.

    The interval is a 95 % range of those per picture if they came independently; those of one scene often do not.
    """
    wrong = _wrong(judged).filter(pl.col("score") >= confidence)
    labels = wrong["label"].to_list()
    return {
        "per_picture": len(wrong) / pictures,
        "number": len(wrong),
        "pictures": pictures,
        "interval": [end / pictures for end in poisson_interval(len(wrong))],
        "pictures_with": Rate(successes=wrong["view"].n_unique(), total=pictures).as_dict(),
        "by_class": {label: labels.count(label) for label in SMALL_CLASSES},
    }


def confidences_at(scores: Sequence[float], pictures: int, rates: Sequence[float] = EQUAL) -> dict[str, float | None]:
    """From which confidence a detector has so many false positives per picture: where detectors are equally strict."""
    wrong = sorted(scores, reverse=True)
    allowed = {f"{rate:g}": math.floor(rate * pictures + 1e-9) for rate in rates}
    return {
        name: math.nextafter(wrong[most], math.inf) if most < len(wrong) else None for name, most in allowed.items()
    }


def poisson_interval(number: int) -> tuple[float, float]:
    """Exact 95 % interval for the mean of a Poisson variable of which `number` was seen (Garwood 1936)."""
    return _gamma_quantile(number, 0.025) if number else 0.0, _gamma_quantile(number + 1, 0.975)


def _gamma_quantile(shape: int, probability: float) -> float:
    """Where the distribution function of a gamma variable of rate 1 has a value, by bisection."""
    low, high = 0.0, shape + 10 * math.sqrt(shape) + 10.0
    for _ in range(100):
        middle = (low + high) / 2
        arguments = torch.tensor([shape, middle], dtype=torch.float64)
        low, high = (middle, high) if float(torch.special.gammainc(*arguments)) < probability else (low, middle)
    return (low + high) / 2
