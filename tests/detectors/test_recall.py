"""Which objects are found, by how they are seen, and what else is reported on them."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from attacks.detectors.base import Detections
from attacks.detectors.classes import COCO_CLASSES, SMALL_CLASSES
from attacks.detectors.errors import DetectorError
from attacks.detectors.evaluation.held_out import evaluate_sets, figures, load_for_evaluation
from attacks.detectors.evaluation.recall import (
    CONDITIONS,
    UNITS,
    ObjectResult,
    bin_names,
    object_results,
    other_classes,
    recall_by,
    reported_as,
)
from attacks.detectors.training.average_precision import assign, score
from attacks.detectors.training.conditions import ViewingConditions
from attacks.detectors.training.pictures import LabelledPicture
from attacks.rate import Rate
from tests.fakes import ColourDetector

HERE, THERE, AWAY = [10.0, 10.0, 50.0, 50.0], [60.0, 60.0, 90.0, 90.0], [0.0, 60.0, 30.0, 90.0]
SEEN = ViewingConditions(elevation=20.0, distance=6.0, extent=4.0, sun_elevation=50.0, sun_strength=0.2)


def picture(*objects: tuple[list[float], int], seen: ViewingConditions | None = SEEN) -> LabelledPicture:
    boxes = torch.tensor([box for box, _ in objects]).reshape(-1, 4)
    labels = torch.tensor([label for _, label in objects], dtype=torch.int64)
    image = torch.full((100, 100, 3), 51, dtype=torch.uint8)
    return LabelledPicture(image, boxes, labels, () if seen is None else (seen,) * len(objects))


def found(*rows: tuple[list[float], float, str]) -> Detections:
    boxes = torch.tensor([box for box, _, _ in rows]).reshape(-1, 4)
    return Detections(boxes, torch.tensor([score for _, score, _ in rows]), tuple(label for _, _, label in rows))


class TableDetector(ColourDetector):
    """Reports what it was told, picture by picture; knows the classes of COCO."""

    classes = COCO_CLASSES

    def __init__(self, *rows: Detections) -> None:
        self.rows = rows

    def detect(self, images: torch.Tensor) -> list[Detections]:
        assert len(images) == len(self.rows)
        return list(self.rows)


def result(label: str, *, is_found: bool, elevation: float, others: tuple[str, ...] = ()) -> ObjectResult:
    return ObjectResult(label=label, found=is_found, reported_as=others, seen={"elevation": elevation})


def test_an_object_is_found_by_a_detection_of_its_own() -> None:
    truth = picture((HERE, 1), (THERE, 1), (AWAY, 2))
    seen = found((HERE, 0.9, "car"), (HERE, 0.8, "car"), (THERE, 0.49, "car"), (AWAY, 0.9, "car"))
    objects = object_results([seen], [truth], SMALL_CLASSES)
    assert [(one.label, one.found, one.reported_as) for one in objects] == [
        ("car", True, ()),
        ("car", False, ()),  # its detection is not confident
        ("person", False, ("car",)),
    ]
    assert [one.found for one in object_results([seen], [truth], SMALL_CLASSES, confidence=0.4)] == [True, True, False]


def test_recall_is_that_of_the_score() -> None:
    generator = torch.Generator().manual_seed(0)
    truths, seen = [], []
    for _ in range(30):
        corners = torch.rand(3, 2, generator=generator) * 60
        boxes = torch.cat([corners, corners + 15 + torch.rand(3, 2, generator=generator) * 20], 1)
        labels = torch.randint(1, 4, (3,), generator=generator)
        truths.append(LabelledPicture(torch.zeros(100, 100, 3, dtype=torch.uint8), boxes, labels))
        moved = (boxes + 12 * (torch.rand(3, 4, generator=generator) - 0.5)).repeat(2, 1)
        names = tuple(SMALL_CLASSES[number - 1] for number in labels.tolist()) * 2
        seen.append(Detections(moved, torch.rand(6, generator=generator), names))
    objects = object_results(seen, truths, SMALL_CLASSES)
    expected = score(seen, truths, SMALL_CLASSES)
    assert score(seen, truths, SMALL_CLASSES, confidence=0.0).recall["car"] > expected.recall["car"]
    for name, recall in expected.recall.items():
        rate = Rate.of((one for one in objects if one.label == name), lambda one: one.found)
        assert rate.total == expected.counts[name]
        assert rate.fraction == pytest.approx(recall)
    assert 0.1 < Rate.of(objects, lambda one: one.found).fraction < 0.9


def test_the_best_detection_takes_the_object() -> None:
    boxes = torch.tensor([HERE, HERE, THERE])
    assert assign(boxes, torch.tensor([0.5, 0.9, 0.7]), torch.tensor([AWAY, HERE])).tolist() == [-1, 1, -1]
    assert assign(boxes, torch.tensor([0.5, 0.9, 0.7]), torch.zeros(0, 4)).tolist() == [-1, -1, -1]


def test_how_an_object_is_seen() -> None:
    (one,) = object_results([found()], [picture((HERE, 1))], SMALL_CLASSES)
    expected = {"elevation": 20.0, "distance": 1.5, "size": 0.4, "brightness": 0.2, "sun_elevation": 50.0}
    assert dict(one.seen) == pytest.approx({**expected, "sun_strength": 0.2})
    (unknown,) = object_results([found()], [picture((HERE, 1), seen=None)], SMALL_CLASSES)
    assert set(unknown.seen) == {"size", "brightness"}


def test_bins_hold_their_lower_edge_and_the_last_one_both() -> None:
    objects = [result("car", is_found=value != 15.0, elevation=value) for value in (0.0, 14.9, 15.0, 89.0, 90.0)]
    bins = recall_by(objects, "elevation")
    assert [(one.low, one.high) for one in bins] == list(pairwise(CONDITIONS["elevation"]))
    assert [(one.rate.successes, one.rate.total) for one in bins] == [(2, 2), (0, 1), (0, 0), (0, 0), (0, 0), (2, 2)]
    assert recall_by(objects, "distance")[0].rate.total == 0, "what is not known is left out"


@pytest.mark.parametrize("condition", CONDITIONS)
def test_edges_rise_and_have_names(condition: str) -> None:
    edges = CONDITIONS[condition]
    assert all(low < high for low, high in pairwise(edges))
    assert len(bin_names(condition)) == len(edges) - 1
    assert set(UNITS) == set(CONDITIONS)
    assert math.isinf(edges[-1]) == bin_names(condition)[-1].endswith("or more")


def test_what_else_is_reported_counts_objects() -> None:
    truth = picture((HERE, 1))
    twice = found((HERE, 0.9, "truck"), (HERE, 0.8, "truck"), (HERE, 0.7, "bus"), (THERE, 0.9, "boat"))
    objects = object_results([twice, found((HERE, 0.6, "truck"))], [truth, truth], SMALL_CLASSES)
    assert reported_as(objects) == {"car": {"truck": 2, "bus": 1}}
    assert list(reported_as(objects)["car"]) == ["truck", "bus"]
    assert reported_as(object_results([found()], [truth], SMALL_CLASSES)) == {}


def test_other_classes_count_detections() -> None:
    rows = [found((HERE, 0.9, "truck"), (THERE, 0.8, "car"), (THERE, 0.8, "bench")), found((HERE, 0.5, "bench"))]
    rows += [found((HERE, 0.4, "kite"))]
    assert other_classes(rows, SMALL_CLASSES) == {"bench": 2, "truck": 1}


def test_a_detector_of_more_classes_is_scored_on_those_of_the_project() -> None:
    truth = [picture((HERE, SMALL_CLASSES.index("person") + 1)), picture()]
    rows = (found((HERE, 0.9, "person"), (THERE, 0.9, "bench")), found((THERE, 0.9, "bicycle"), (AWAY, 0.9, "car")))
    one = evaluate_sets(TableDetector(*rows), {"mixed": truth})["mixed"]
    assert one.score is not None
    assert one.score.ap == {"person": 1.0}
    assert (one.false_positives.total, one.false_positives.by_class["car"]) == (1, 1)
    assert set(one.false_positives.by_class) == set(SMALL_CLASSES)
    assert one.other_classes == {"bench": 1, "bicycle": 1}
    shown = figures({"mixed": one})["mixed"]
    assert shown["recall_by"]["elevation"]["all"][1]["successes"] == 1
    assert "car" not in shown["recall_by"]["elevation"], "there is none"
    assert shown["recall_by"]["distance"]["all"][-1]["high"] is None


def test_unlikely_detections_are_kept_where_that_can_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    class Floored(TableDetector):
        def __init__(self) -> None:
            self.min_confidence = 0.25

    made: list[ColourDetector] = [Floored(), TableDetector()]
    monkeypatch.setattr("attacks.detectors.evaluation.held_out.load_detector", lambda name, weights: made.pop(0))
    assert load_for_evaluation("floored").min_confidence == 0.001
    assert load_for_evaluation("plain").min_confidence == 0.05, "it cannot be chosen"


def test_a_detector_without_the_project_s_classes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("attacks.detectors.evaluation.held_out.load_detector", lambda name, weights: ColourDetector())
    with pytest.raises(DetectorError, match=r"detector few: expected one of car, .*got one without elephant, bird"):
        load_for_evaluation("few")
