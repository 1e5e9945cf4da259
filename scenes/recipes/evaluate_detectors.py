"""Scores detectors on held-out images: `python -m scenes.recipes.evaluate_detectors
--detectors fasterrcnn_small`.

Average precision by class; recall by elevation, distance, size, brightness and sun; and
false positives per image, with and without objects. A detector of other classes is
scored on those of the project's eight that it knows. A detection is right if it
overlaps an object of its class that no more confident one has taken, by half or more.
Writes result.json, from which `python docs/figures/detector_figures.py FILE` makes
tables.
"""

import argparse
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from scipy.stats import gamma
from torch import Tensor
from torchvision.ops import box_iou

from attacks.detectors.base import Detections, Detector
from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.registry import load_detector
from attacks.figures.rate import Rate
from attacks.gaussian_subset import GaussianSubset
from attacks.observe.views import visible_box, visible_weight
from mi_splat import provenance
from mi_splat.io.documents import save_json
from mi_splat.io.images import to_bytes
from mi_splat.render.renderer import Renderer
from mi_splat.render.scene_files import open_scene
from scenes.recipes.detector_pictures import (
    EMPTY,
    PATH_TRACED,
    SPLAT_RENDERS,
    LabelledPicture,
    held_out_sets,
    made,
    viewing_conditions,
)

MIN_CONFIDENCE = 0.001
"""Confidence of detections that count in an average precision, of detectors whose floor
can be chosen.
"""
LEAST_OVERLAP = 0.5
CONDITIONS: dict[str, tuple[float, ...]] = {
    "elevation": (0, 15, 30, 45, 60, 75, 90),
    "distance": (0, 1.5, 2.5, 4, 6, math.inf),
    "size": (0, 0.2, 0.35, 0.5, 0.75, 1),
    "brightness": (0, 0.2, 0.3, 0.4, 1),
    "sun_elevation": (0, 30, 45, 60, 90),
    "sun_strength": (0, 0.5, 1.5, 2.5, math.inf),
}
"""How an object is seen, and the edges of the bins in which recall is given.

elevation: degrees above the horizontal plane, of the camera as seen from the object.
distance: from the camera to the object, in diagonals of the object's box in the world.
size: longer side of the box, in sides of the image. brightness: mean luma (Rec. 709
weights on sRGB values) in that box. sun_elevation: degrees above the horizon.
sun_strength: irradiance of the sun on a surface that faces it, 0 under a closed cover
of clouds.
"""
_BATCH = 16
_LUMA = torch.tensor((0.2126, 0.7152, 0.0722))


@dataclass(frozen=True, slots=True, kw_only=True)
class Reported:
    """A detection: its object, the overlap with it, and whether it is the best one of
    the object's class.
    """

    label: str
    score: float
    owner: int | None
    overlap: float
    right: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What a detector reports in an image: of each known object its class, conditions
    and score; and all detections.
    """

    objects: Mapping[int, Mapping[str, Any]]
    detections: Sequence[Reported]


def look_at(detector: Detector, pictures: Sequence[LabelledPicture]) -> list[Seen]:
    """What a detector reports in images of one size."""
    seen = []
    for start in range(0, len(pictures), _BATCH):
        part = pictures[start : start + _BATCH]
        results = detector.detect(
            torch.stack([picture.image for picture in part]).float() / 255
        )
        seen += [
            _matched(detector, result, picture)
            for result, picture in zip(results, part, strict=True)
        ]
    return seen


def _matched(detector: Detector, result: Detections, picture: LabelledPicture) -> Seen:
    """The most confident detections choose their objects first; the others belong to
    what they overlap most.
    """
    names = [SMALL_CLASSES[label - 1] for label in picture.labels.tolist()]
    iou: list[list[float]] = box_iou(result.boxes.cpu(), picture.boxes).tolist()
    owners = [
        max(range(len(names)), key=shared.__getitem__, default=None) for shared in iou
    ]
    taken = set[int]()
    for row in torch.argsort(
        result.scores.cpu(), descending=True, stable=True
    ).tolist():
        free = [
            index
            for index, name in enumerate(names)
            if name == result.labels[row] and index not in taken
        ]
        nearest = max(free, key=iou[row].__getitem__, default=None)
        if nearest is not None and iou[row][nearest] >= LEAST_OVERLAP:
            owners[row] = nearest
            taken.add(nearest)
    scores: list[float] = result.scores.tolist()
    overlaps = [
        0.0 if owner is None else iou[row][owner] for row, owner in enumerate(owners)
    ]
    detections = list[Reported]()
    fitting = set[int]()
    for row in sorted(range(len(scores)), key=lambda row: -scores[row]):
        owner = owners[row]
        label = result.labels[row]
        fits = (
            owner is not None
            and label == names[owner]
            and overlaps[row] >= LEAST_OVERLAP
        )
        right = fits and owner not in fitting
        if owner is not None and fits:
            fitting.add(owner)
        detections.append(
            Reported(
                label=label,
                score=scores[row],
                owner=owner,
                overlap=overlaps[row],
                right=right,
            )
        )
    best = {found.owner: found.score for found in detections if found.right}
    known = [number for number, name in enumerate(names) if name in detector.classes]
    objects = {
        number: {**_conditions(picture, number), "score": best.get(number, 0.0)}
        for number in known
    }
    return Seen(objects=objects, detections=detections)


def _conditions(picture: LabelledPicture, number: int) -> dict[str, Any]:
    x0, y0, x1, y1 = map(round, picture.boxes[number].tolist())
    inside = picture.image[y0:y1, x0:x1].float() / 255
    values: dict[str, Any] = {
        "label": SMALL_CLASSES[int(picture.labels[number]) - 1],
        "size": max(x1 - x0, y1 - y0) / max(picture.image.shape[:2]),
        "brightness": float((inside @ _LUMA).mean()) if inside.numel() else None,
    }
    if picture.conditions:
        how = picture.conditions[number]
        values |= how._asdict() | {"distance": how.distance / how.extent}
    return values


def set_figures(seen: Sequence[Seen], confidence: float) -> dict[str, Any]:
    """Every figure of one set as JSON can hold it; average precision and recall only
    where there are objects.
    """
    detections = [found for view in seen for found in view.detections]
    others = [
        d.label
        for d in detections
        if d.score >= confidence and d.label not in SMALL_CLASSES
    ]
    values = {
        "pictures": len(seen),
        "false_positives": false_positives(seen, confidence),
        "other_classes": dict(Counter(sorted(others)).most_common()),
    }
    objects = [item for view in seen for item in view.objects.values()]
    if not objects:
        return values
    labels = [
        label
        for label in SMALL_CLASSES
        if any(item["label"] == label for item in objects)
    ]
    rates = {
        label: _recall([item for item in objects if item["label"] == label], confidence)
        for label in labels
    }
    ap = {
        label: average_precision(
            [d for d in detections if d.label == label], rates[label].total
        )
        for label in labels
    }
    return {
        **values,
        "ap": ap,
        "map": sum(ap.values()) / len(ap),
        "found": {label: rate.as_dict() for label, rate in rates.items()},
        "found_by": {
            name: bins
            for name in CONDITIONS
            if (bins := _by_condition(objects, name, confidence))
        },
        "reported_as": _reported_as(seen, confidence, labels),
    }


def _recall(objects: Sequence[Mapping[str, Any]], confidence: float) -> Rate:
    return Rate(
        successes=sum(item["score"] >= confidence for item in objects),
        total=len(objects),
    )


def _by_condition(
    objects: Sequence[Mapping[str, Any]], name: str, confidence: float
) -> dict[str, list[Any]]:
    """Recall in the bins of a condition, of all objects and of cars; a bin has its
    lower edge, the last one both.
    """
    edges = CONDITIONS[name]
    bins = {}
    for group in ("all", "car"):
        known = [
            i
            for i in objects
            if i.get(name) is not None and group in ("all", i["label"])
        ]
        if known:
            parts = [
                (
                    low,
                    high,
                    [
                        i
                        for i in known
                        if low <= i[name] < high or i[name] == high == edges[-1]
                    ],
                )
                for low, high in pairwise(edges)
            ]
            bins[group] = [
                {
                    "from": low,
                    "to": high if math.isfinite(high) else None,
                    **_recall(part, confidence).as_dict(),
                }
                for low, high, part in parts
            ]
    return bins


def _reported_as(
    seen: Sequence[Seen], confidence: float, labels: Sequence[str]
) -> dict[str, dict[str, int]]:
    """Class of the objects to what else is reported on them, and on how many."""
    counts: dict[str, Counter[str]] = {label: Counter() for label in labels}
    for view in seen:
        for number, item in view.objects.items():
            on_object = {
                d.label
                for d in view.detections
                if d.owner == number
                and d.overlap >= LEAST_OVERLAP
                and d.score >= confidence
            }
            counts[item["label"]].update(sorted(on_object - {item["label"]}))
    return {
        label: dict(counted.most_common())
        for label, counted in counts.items()
        if counted
    }


def average_precision(detections: Sequence[Reported], objects: int) -> float:
    """Area under the precision-recall curve, precision made monotonous (all-point
    interpolation of PASCAL VOC 2010).
    """
    best_first = sorted(detections, key=lambda found: -found.score)
    hits = torch.tensor([found.right for found in best_first], dtype=torch.float64)
    precision = hits.cumsum(0) / torch.arange(1, len(hits) + 1)
    best_later = precision.flip(0).cummax(0).values.flip(0) if len(hits) else precision
    return float((best_later * hits).sum() / objects)


def false_positives(seen: Sequence[Seen], confidence: float) -> dict[str, Any]:
    """False positives as JSON can hold them, with the 95 % Poisson interval (Garwood
    1936).
    """
    wrong = [[d.label for d in _wrong(view) if d.score >= confidence] for view in seen]
    labels = [label for part in wrong for label in part]
    count = len(labels)
    pictures = max(len(seen), 1)
    low = gamma.ppf(0.025, count) if count else 0.0
    high = gamma.ppf(0.975, count + 1)
    return {
        "per_picture": count / pictures,
        "number": count,
        "pictures": len(seen),
        "interval": [float(low) / pictures, float(high) / pictures],
        "pictures_with": (
            Rate(successes=sum(map(bool, wrong)), total=len(seen)).as_dict()
        ),
        "by_class": {label: labels.count(label) for label in SMALL_CLASSES},
    }


def _wrong(view: Seen) -> list[Reported]:
    return [
        found
        for found in view.detections
        if not found.right and found.label in SMALL_CLASSES
    ]


def confidences_at(seen: Sequence[Seen]) -> dict[str, float | None]:
    """From which confidence a detector has so many false positives per image: where
    detectors are equally strict.
    """
    wrong = sorted(
        (found.score for view in seen for found in _wrong(view)), reverse=True
    )
    allowed = {
        f"{rate:g}": math.floor(rate * len(seen) + 1e-9) for rate in (0.01, 0.1, 1.0)
    }
    return {
        name: math.nextafter(wrong[most], math.inf) if most < len(wrong) else None
        for name, most in allowed.items()
    }


def detector_figures(
    seen: Mapping[str, Sequence[Seen]], confidence: float
) -> dict[str, Any]:
    """The figures of one detector: of each set, and false positives of those with and
    without objects together.
    """
    together = {
        "with objects": [name for name in seen if name in (PATH_TRACED, SPLAT_RENDERS)],
        "without objects": [name for name in seen if name.startswith(EMPTY)],
    }
    together["all"] = [name for names in together.values() for name in names]
    totals = {}
    for which, names in together.items():
        views = [view for name in names for view in seen[name]]
        if views:
            totals[which] = {
                **false_positives(views, confidence),
                "confidence_at": confidences_at(views),
            }
    sets = {name: set_figures(views, confidence) for name, views in seen.items()}
    return {"sets": sets, "false_positives": totals}


def splat_scene_pictures(path: Path) -> list[LabelledPicture]:
    """A splat scene XML from each of its cameras at 8 bits; shapes whose id is a class
    (or stop_sign) are objects.
    """
    loaded = open_scene(path)
    render = Renderer(loaded.settings)
    pictures = []
    for camera in loaded.cameras.values():
        with torch.no_grad():
            image = torch.from_numpy(to_bytes(render(loaded.scene, camera)))
        boxes = list[Tensor]()
        labels = list[int]()
        conditions = []
        for number, name in enumerate(SMALL_CLASSES, start=1):
            mask = loaded.objects.get(name, loaded.objects.get(name.replace(" ", "_")))
            if mask is None:
                continue
            box = visible_box(
                visible_weight(GaussianSubset.of(loaded.scene, mask), camera, render)
            )
            if box is not None:
                boxes.append(box[None])
                labels.append(number)
                conditions.append(
                    viewing_conditions(loaded.scene.means[mask].numpy(), camera)
                )
        stacked = torch.cat([torch.zeros(0, 4), *boxes])
        pictures.append(
            LabelledPicture(
                image,
                stacked,
                torch.tensor(labels, dtype=torch.int64),
                tuple(conditions),
            )
        )
    return pictures


def main() -> None:
    """Make what is missing, let every detector look, and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--detectors", nargs="+", default=["fasterrcnn_small"])
    parser.add_argument(
        "--weights",
        nargs="+",
        type=Path,
        default=[],
        help="a file for each detector, in order",
    )
    parser.add_argument("--data", type=Path, default=Path("out/detector-data"))
    parser.add_argument("--out", type=Path, default=Path("out/detectors/result.json"))
    parser.add_argument(
        "--pictures",
        type=int,
        default=80,
        help="path-traced scenes, three images of each",
    )
    parser.add_argument(
        "--splats", type=int, default=32, help="scenes that are made into splats"
    )
    parser.add_argument(
        "--backgrounds",
        type=int,
        default=12,
        help="scenes of each kind without objects",
    )
    parser.add_argument(
        "--scenes",
        nargs="*",
        type=Path,
        default=[],
        help="splat scene XMLs to score as well",
    )
    parser.add_argument("--confidence", type=float, default=0.5)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    sets = held_out_sets(
        pictures=options.pictures,
        splats=options.splats,
        backgrounds=options.backgrounds,
    )
    images = dict(
        zip(
            sets,
            made(options.data, list(sets.values()), processes=options.processes),
            strict=True,
        )
    )
    images |= {str(path): splat_scene_pictures(path) for path in options.scenes}
    figures: dict[str, Any] = {}
    for number, name in enumerate(options.detectors):
        detector: Any = load_detector(
            name, weights=dict(enumerate(options.weights)).get(number)
        )
        if "min_confidence" in getattr(detector, "__dict__", {}):
            detector.min_confidence = MIN_CONFIDENCE
        lacks = [label for label in SMALL_CLASSES if label not in detector.classes]
        figures[name] = {
            "fingerprint": detector.fingerprint,
            "min_confidence": detector.min_confidence,
            **({"lacks": lacks} if lacks else {}),
            **detector_figures(
                {key: look_at(detector, part) for key, part in images.items()},
                options.confidence,
            ),
        }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    made_of = {
        name: getattr(options, name) for name in ("pictures", "splats", "backgrounds")
    }
    record = {
        "confidence": options.confidence,
        "detectors": figures,
        "pictures": made_of,
        **provenance.origin(),
    }
    save_json(record, options.out)


if __name__ == "__main__":
    main()
