"""How detections compare with labelled pictures, and the tables and commands that show it."""

from __future__ import annotations

import json
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from scipy.stats import chi2

from attacks import cli
from attacks.detectors.base import Detections
from attacks.detectors.catalogue import SMALL_CLASSES, DetectorError
from attacks.detectors.evaluation.held_out import load_for_evaluation, measure_sets
from attacks.detectors.evaluation.measure import (
    CONDITIONS,
    Measurement,
    ObjectRow,
    average_precision,
    confidences_at,
    false_positives,
    measure,
    poisson_interval,
)
from attacks.detectors.evaluation.tables import comparison, detector_tables, read_figures
from attacks.detectors.training.config import BACKGROUNDS, BackgroundConfig
from attacks.detectors.training.pictures import LabelledPicture
from mi_splat.errors import InvalidValueError
from tests.detectors.made import AWAY, HERE, THERE, TableDetector, document, picture, reported
from tests.fakes import ColourDetector

# Matches and average precision


def test_average_precision_of_cases_done_by_hand() -> None:
    scores = torch.tensor([0.9, 0.8, 0.7, 0.6])
    assert average_precision(scores, torch.tensor([True, True, False, False]), 2) == 1.0
    assert average_precision(scores, torch.tensor([False, False, True, True]), 2) == pytest.approx(0.5)
    # Right, wrong, right, wrong of two: precision 1 up to recall 1/2, then 2/3.
    assert average_precision(scores, torch.tensor([True, False, True, False]), 2) == pytest.approx((1 + 2 / 3) / 2)
    assert average_precision(scores.flip(0), torch.tensor([False, True, False, True]), 4) == pytest.approx(
        (1 + 2 / 3) / 4
    )
    assert average_precision(torch.empty(0), torch.empty(0, dtype=torch.bool), 3) == 0.0


def test_the_best_detection_takes_the_object() -> None:
    near = [10.0, 10.0, 50.0, 46.0]
    seen = reported((near, 0.5, "car"), (HERE, 0.9, "car"), (THERE, 0.99, "car"))
    rows = measure([seen], [picture((AWAY, 1), (HERE, 1))], SMALL_CLASSES).detections
    assert [row.right for row in rows] == [False, True, False]
    assert [row.right for row in measure([seen], [picture()], SMALL_CLASSES).detections] == [False] * 3


def test_scores_are_kept_apart_by_class_and_picture() -> None:
    right, wrong = reported((HERE, 0.8, "car")), reported((HERE, 0.9, "car"))
    result = measure([right, wrong], [picture((HERE, 1)), picture((HERE, 2))], SMALL_CLASSES)
    assert result.counts == {"car": 1, "person": 1}
    assert result.ap == {"car": 0.5, "person": 0.0}
    assert result.recall == {"car": 1.0, "person": 0.0}
    assert result.mean == 0.25


def test_an_object_is_found_by_a_detection_of_its_own() -> None:
    truth = picture((HERE, 1), (THERE, 1), (AWAY, 2))
    seen = reported((HERE, 0.9, "car"), (HERE, 0.8, "car"), (THERE, 0.49, "car"), (AWAY, 0.9, "car"))
    objects = measure([seen], [truth], SMALL_CLASSES).objects
    assert [(row.label, row.found, row.reported_as) for row in objects] == [
        ("car", True, ()),
        ("car", False, ()),  # its detection is not confident
        ("person", False, ("car",)),
    ]
    lower = measure([seen], [truth], SMALL_CLASSES, confidence=0.4).objects
    assert [row.found for row in lower] == [True, True, False]


def test_confidence_changes_who_counts_and_not_who_matches() -> None:
    """A detection that does not count takes no object away from one that does."""
    generator = torch.Generator().manual_seed(0)
    truths, seen, likely = [], [], []
    for _ in range(30):
        corners = torch.rand(3, 2, generator=generator) * 60
        boxes = torch.cat([corners, corners + 15 + torch.rand(3, 2, generator=generator) * 20], 1)
        labels = torch.randint(1, 4, (3,), generator=generator)
        truths.append(LabelledPicture(torch.zeros(100, 100, 3, dtype=torch.uint8), boxes, labels))
        moved = (boxes + 12 * (torch.rand(3, 4, generator=generator) - 0.5)).repeat(2, 1)
        names = tuple(SMALL_CLASSES[number - 1] for number in labels.tolist()) * 2
        scores = torch.rand(6, generator=generator)
        seen.append(Detections(moved, scores, names))
        kept = (scores >= 0.5).nonzero()[:, 0]
        likely.append(Detections(moved[kept], scores[kept], tuple(names[i] for i in kept.tolist())))
    every, few = measure(seen, truths, SMALL_CLASSES), measure(likely, truths, SMALL_CLASSES)
    assert every.objects == few.objects
    assert every.recall == few.recall
    found = [row.found for row in every.objects]
    assert 0.1 < sum(found) / len(found) < 0.9
    assert false_positives([every]) == false_positives([few])
    assert measure(seen, truths, SMALL_CLASSES, confidence=0.0).recall["car"] > every.recall["car"]


# How objects are seen, and what else is reported on them


def test_how_an_object_is_seen() -> None:
    (row,) = measure([reported()], [picture((HERE, 1))], SMALL_CLASSES).objects
    expected = {"elevation": 50.0, "distance": 1.5, "size": 0.4, "brightness": 0.2, "sun_elevation": 20.0}
    assert dict(row.seen) == pytest.approx({**expected, "sun_strength": 0.2})
    (unknown,) = measure([reported()], [picture((HERE, 1), seen=None)], SMALL_CLASSES).objects
    assert set(unknown.seen) == {"size", "brightness"}


def test_bins_hold_their_lower_edge_and_the_last_one_both() -> None:
    seen = [(value, value != 15.0) for value in (0.0, 14.9, 15.0, 89.0, 90.0)]
    rows = tuple(ObjectRow("car", is_found, (), {"elevation": value}) for value, is_found in seen)
    result = Measurement(pictures=5, classes=SMALL_CLASSES, detections=(), objects=rows)
    rates = result.recall_by("elevation")
    assert [(rate.successes, rate.total) for rate in rates] == [(2, 2), (0, 1), (0, 0), (0, 0), (0, 0), (2, 2)]
    assert result.recall_by("distance")[0].total == 0, "what is not known is left out"
    assert sum(rate.total for rate in result.recall_by("elevation", "bird")) == 0


@pytest.mark.parametrize("name", CONDITIONS)
def test_edges_rise_and_have_names(name: str) -> None:
    edges, bins = CONDITIONS[name].edges, CONDITIONS[name].bins
    assert all(low < high for low, high in pairwise(edges))
    assert len(bins) == len(edges) - 1
    assert (edges[-1] == float("inf")) == bins[-1].endswith("or more")


def test_what_else_is_reported_counts_objects() -> None:
    truth = picture((HERE, 1))
    twice = reported((HERE, 0.9, "truck"), (HERE, 0.8, "truck"), (HERE, 0.7, "bus"), (THERE, 0.9, "boat"))
    others = measure([twice, reported((HERE, 0.6, "truck"))], [truth, truth], SMALL_CLASSES).reported_as
    assert others == {"car": {"truck": 2, "bus": 1}}
    assert list(others["car"]) == ["truck", "bus"]
    assert measure([reported()], [truth], SMALL_CLASSES).reported_as == {}


def test_other_classes_count_detections() -> None:
    rows = [reported((HERE, 0.9, "truck"), (THERE, 0.8, "car"), (THERE, 0.8, "bench")), reported((HERE, 0.5, "bench"))]
    rows += [reported((HERE, 0.4, "kite"))]
    assert measure(rows, [picture()] * 3, SMALL_CLASSES).other_classes == {"bench": 2, "truck": 1}


# False positives


@pytest.mark.parametrize(
    ("detections", "cars", "people"),
    [
        (reported(), 0, 0),
        (reported((HERE, 0.9, "car")), 0, 0),
        (reported((HERE, 0.9, "person")), 0, 1),  # the right place, the wrong class
        (reported((THERE, 0.9, "car")), 1, 0),
        (reported((THERE, 0.5, "car")), 1, 0),  # 0.5 counts
        (reported((THERE, 0.49, "car")), 0, 0),
        (reported((HERE, 0.9, "car"), (HERE, 0.8, "car")), 1, 0),  # an object is found once
        (reported((HERE, 0.9, "car"), (THERE, 0.8, "person"), (THERE, 0.7, "person")), 0, 2),
        (reported(([10.0, 10.0, 50.0, 29.0], 0.9, "car")), 1, 0),  # overlaps by 0.475
        (reported(([10.0, 10.0, 50.0, 31.0], 0.9, "car")), 0, 0),  # by 0.525
    ],
)
def test_what_counts_as_a_false_positive(detections: Detections, cars: int, people: int) -> None:
    wrong = false_positives([measure([detections], [picture((HERE, 1))], ("car", "person"))])
    assert wrong["by_class"] == {"car": cars, "person": people}
    assert wrong["pictures_with"] == int(cars + people > 0)


def test_pictures_are_counted_and_matched_apart() -> None:
    results = [reported((HERE, 0.9, "car")), reported((THERE, 0.9, "car"), (HERE, 0.8, "person")), reported()]
    pictures = [picture((HERE, 1)), picture((HERE, 1)), picture()]
    wrong = false_positives([measure(results, pictures, SMALL_CLASSES)])
    assert (wrong["pictures"], wrong["pictures_with"], wrong["total"]) == (3, 1, 2)
    assert wrong["per_picture"] == pytest.approx(2 / 3)
    assert wrong["interval"] == [end / 3 for end in poisson_interval(2)]


@pytest.mark.parametrize("count", [0, 1, 2, 7, 60, 400])
def test_the_interval_is_garwood_s(count: int) -> None:
    low, high = poisson_interval(count)
    assert low == pytest.approx(chi2.ppf(0.025, 2 * count) / 2 if count else 0.0, rel=1e-6)
    assert high == pytest.approx(chi2.ppf(0.975, 2 * count + 2) / 2, rel=1e-6)


def test_detectors_are_equally_strict_where_they_have_as_many_false_positives() -> None:
    scores = (0.875, 0.625, 0.625, 0.25)
    wrong = [reported((HERE, score, "car"), (HERE, 0.95, "kite")) for score in scores]
    right = reported((HERE, 0.8, "car"))
    sets = [measure([*wrong, right], [*[picture()] * 4, picture((HERE, 1))], SMALL_CLASSES)]
    least = confidences_at(sets, (0.0, 0.2, 0.4, 0.6, 1.0))
    counted = {name: sum(score >= (floor or 0) for score in scores) for name, floor in least.items()}
    assert counted == {"0": 0, "0.2": 1, "0.4": 1, "0.6": 3, "1": 4}  # of equal ones all or none
    assert least["1"] is None


# Detectors


def test_a_detector_of_more_classes_is_scored_on_those_of_the_project() -> None:
    sets = {"mixed": [picture((HERE, SMALL_CLASSES.index("person") + 1)), picture()], "without": [picture()] * 2}
    rows = reported((HERE, 0.9, "person"), (THERE, 0.9, "bench")), reported((THERE, 0.9, "bicycle"), (AWAY, 0.9, "car"))
    measured = measure_sets(TableDetector(*rows), sets)
    mixed = measured["mixed"]
    assert mixed.ap == {"person": 1.0}
    assert mixed.other_classes == {"bench": 1, "bicycle": 1}
    shown = mixed.as_dict()
    assert shown["false_positives"]["total"] == shown["false_positives"]["by_class"]["car"] == 1
    assert set(shown["false_positives"]["by_class"]) == set(SMALL_CLASSES)
    assert shown["recall_by"]["elevation"]["all"][3]["successes"] == 1
    assert "car" not in shown["recall_by"]["elevation"], "there is none"
    assert shown["recall_by"]["distance"]["all"][-1]["high"] is None
    assert json.loads(json.dumps(shown)) == shown
    without = measured["without"].as_dict()
    assert without["pictures"] == 2
    assert "map" not in without


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


# Tables


def test_totals_leave_out_scenes_of_the_user() -> None:
    totals = document()["false_positives"]
    assert {name: (wrong["total"], wrong["pictures"]) for name, wrong in totals.items()} == {
        "with objects": (3, 4),
        "without objects": (2, 16),
        "all": (5, 20),
    }
    assert (totals["all"]["by_class"]["car"], totals["all"]["by_class"]["tv"]) == (0, 5)
    assert totals["without objects"]["pictures_with"] == 2


def test_the_tables_of_a_detector_hold_its_figures() -> None:
    text = detector_tables(document())
    assert "| car | 0.50 | 4 | 50 % |" in text
    assert "| person | - | 0 | - |" in text
    assert "| **mean** | **0.500** | 4 in 4 pictures |  |" in text
    assert "| 45 to 60 | 50 % (2/4; 15 to 85) | 50 % (2/4; 15 to 85) |" in text, "of all objects, and of cars"
    assert "| 0 to 15 | - | - |" in text
    assert "| scenes/x.xml | car | 0.50 | 4 | 50 % |" in text
    assert "| background: street | 0.25 (2/8; 0.03 to 0.90) | 2/8 | tv 2 |" in text
    assert "| **together, without objects** | 0.12 (2/16; 0.02 to 0.45) | 2/16 | tv 2 |" in text
    assert "| car | of 4: truck 1 | of 0: nothing |" in text
    assert "| path traced | 4 | kite 1, truck 1 |" in text
    for condition in CONDITIONS:
        assert f"**{condition.replace('_', ' ')}**" in text


def test_a_detector_of_no_other_classes_has_no_such_table() -> None:
    figures = document()
    for part in figures["sets"].values():
        part["other_classes"] = {}
    assert "other classes" not in detector_tables(figures)


def test_detectors_side_by_side() -> None:
    text = comparison([document("one"), document("two", confidence=0.3)])
    row = "0.500 | - | 0.75 (3/4; 0.15 to 2.19) | 0.25 (2/8; 0.03 to 0.90) | 0.12 (2/16; 0.02 to 0.45) |"
    assert f"| `one` | {row}" in text
    assert text.count("| `two` at 0.3 | ") == 3, "and recall of objects and of cars"
    assert "splat renders:" not in text, "no detector has seen any"
    assert "cars, path traced and splat renders together:" in text
    assert "from a confidence of 0.3" in detector_tables(document(confidence=0.3))


def test_figures_are_read_from_both_kinds_of_files(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(document()))
    (tmp_path / "card.json").write_text(json.dumps({"history": [], "held_out": document()}))
    assert read_figures(tmp_path / "a.json") == read_figures(tmp_path / "card.json") == document()


@pytest.mark.parametrize("text", ["{}", "[1]", "{", '{"held_out": 3}'])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InvalidValueError, match="expected figures of a detector"):
        read_figures(tmp_path / "x.json")


# Commands


def test_the_command_compares_and_keeps_all_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [tmp_path / f"{name}.json" for name in ("one", "two")]
    for path in paths:
        path.write_text(json.dumps(document(path.stem)))
    out = tmp_path / "new" / "both.compared.json"
    assert cli.main(["compare-detectors", *map(str, paths), "--out", str(out)]) == 0
    assert json.loads(out.read_text())["compared"] == [document("one"), document("two")]
    assert capsys.readouterr().out.startswith(comparison([document("one"), document("two")]))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["compare-detectors"], "files: expected at least one, got none"),
        (["compare-detectors", "{}/one.json", "--out", "{}/x.json"], "a file name that ends in .compared.json"),
        (["compare-detectors", "{}/none.json"], "No such file"),
        (["evaluate-detector", "--out", "{}/x.png"], "a file name that ends in .json"),
    ],
)
def test_wrong_files_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    (tmp_path / "one.json").write_text(json.dumps(document()))
    assert cli.main([word.format(tmp_path) for word in words]) == 1
    assert says in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.json"]


@pytest.mark.slow
def test_the_command_scores_pictures_backgrounds_and_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = asdict(BackgroundConfig(scenes=1, shots=2, samples=1, size=64))
    flags = [f"--backgrounds.{name}={sizes[name]}" for name in ("scenes", "shots", "samples", "size")]
    words = ["evaluate-detector", "--data", str(tmp_path), "--out", str(tmp_path / "figures.json"), *flags]
    words += ["--pictures=3", "--samples=1", "--splats=0", "--processes=0"]
    words += ["--scenes", "scenes/car_street.xml", "scenes/stop_sign.xml"]
    assert cli.main([*words, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown == json.loads((tmp_path / "figures.json").read_text())
    assert set(shown["sets"]) == {
        "path traced",
        "scenes/car_street.xml",
        "scenes/stop_sign.xml",
        *(f"background: {k}" for k in BACKGROUNDS),
    }
    street = shown["sets"]["scenes/car_street.xml"]
    assert (street["pictures"], street["counts"]) == (6, {"car": 6})
    assert street["recall"]["car"] == 1.0
    assert shown["sets"]["scenes/stop_sign.xml"]["recall"] == {"stop sign": 1.0}
    assert len(shown["fingerprint"]) == 16
    assert shown["sets"]["path traced"]["recall_by"]["elevation"]["all"]
    assert shown["pictures"]["backgrounds"]["scenes"] == 1
    assert cli.main(words) == 0
    assert "| background: street | " in capsys.readouterr().out
