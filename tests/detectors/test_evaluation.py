"""How detections compare with labelled pictures, and the tables and commands that show it."""

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
from attacks.detectors.evaluation import (
    CONDITIONS,
    average_precision,
    confidences_at,
    figures,
    lacking,
    load_for_evaluation,
    look_at,
    poisson_interval,
    set_figures,
    with_right,
)
from attacks.detectors.training.config import BACKGROUNDS, BackgroundConfig
from attacks.detectors.training.pictures import LabelledPicture, ViewingConditions
from attacks.observe.rows import DETECTIONS, ROWS, read_rows, rows
from attacks.report.checking import check_detections, check_figures, read_result
from attacks.report.stories.detectors.held_out import bins_of, documents, tables
from mi_splat.io.documents import save_json
from mi_splat.io.manifest import write_manifest
from tests.detectors.made import AWAY, HERE, THERE, TableDetector, evaluated, measured, picture, reported, seen_by
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


def right_in(results: list[Detections], pictures: list[LabelledPicture]) -> list[bool]:
    looked = seen_by(results, pictures)
    right: list[bool] = with_right(looked.rows, looked.detections)["right"].to_list()
    return right


def test_the_best_detection_takes_the_object() -> None:
    near = [10.0, 10.0, 50.0, 46.0]
    seen = reported((near, 0.5, "car"), (HERE, 0.9, "car"), (THERE, 0.99, "car"))
    assert right_in([seen], [picture((AWAY, 1), (HERE, 1))]) == [False, True, False]
    assert right_in([seen], [picture()]) == [False] * 3
    twins = reported((HERE, 0.9, "car"), (HERE, 0.8, "car"))
    assert right_in([twins], [picture((HERE, 1), (near, 1))]) == [True, True], "the second takes what is left"


def test_scores_are_kept_apart_by_class_and_picture() -> None:
    right, wrong = reported((HERE, 0.8, "car")), reported((HERE, 0.9, "car"))
    result = measured([right, wrong], [picture((HERE, 1)), picture((HERE, 2))])
    assert {label: (rate["successes"], rate["total"]) for label, rate in result["found"].items()} == {
        "car": (1, 1),
        "person": (0, 1),
    }
    assert result["ap"] == {"car": 0.5, "person": 0.0}
    assert result["map"] == 0.25


def test_an_object_is_found_by_a_detection_of_its_own() -> None:
    truth = picture((HERE, 1), (THERE, 1), (AWAY, 2))
    seen = reported((HERE, 0.9, "car"), (HERE, 0.8, "car"), (THERE, 0.49, "car"), (AWAY, 0.9, "car"))
    objects = seen_by([seen], [truth]).rows
    assert objects["original"].to_list() == ["car", "car", "person"]
    assert objects["original_score"].to_list() == pytest.approx([0.9, 0.49, 0.0])
    result = measured([seen], [truth])
    assert result["found"]["car"]["successes"] == 1, "the other's detection is not confident"
    assert result["reported_as"] == {"person": {"car": 1}}
    assert measured([seen], [truth], confidence=0.4)["found"]["car"]["successes"] == 2


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
    every, few = measured(seen, truths), measured(likely, truths)
    assert every["found"] == few["found"]
    assert every["false_positives"] == few["false_positives"]
    successes, total = (sum(rate[key] for rate in every["found"].values()) for key in ("successes", "total"))
    assert 0.1 < successes / total < 0.9
    assert measured(seen, truths, confidence=0.0)["found"]["car"]["rate"] > every["found"]["car"]["rate"]


# How objects are seen, and what else is reported on them


def test_how_an_object_is_seen() -> None:
    (row,) = seen_by([reported()], [picture((HERE, 1))]).rows.to_dicts()
    expected = {"elevation": 50.0, "distance": 6.0, "extent": 4.0, "size": 0.4, "brightness": 0.2}
    expected |= {"sun_elevation": 20.0, "sun_strength": 0.2}
    assert {name: row[name] for name in expected} == pytest.approx(expected)
    unknown = measured([reported()], [picture((HERE, 1), seen=None)])
    assert set(unknown["found_by"]) == {"size", "brightness"}, "what is not known is left out"


def test_bins_hold_their_lower_edge_and_the_last_one_both() -> None:
    hit, miss = reported((HERE, 0.9, "car")), reported()
    seen = [ViewingConditions(elevation=value, distance=6.0, extent=4.0) for value in (0.0, 14.9, 15.0, 89.0, 90.0)]
    by = measured([hit, hit, miss, hit, hit], [picture((HERE, 1), seen=how) for how in seen])["found_by"]
    counts = [(rate["successes"], rate["total"]) for rate in by["elevation"]["all"]]
    assert counts == [(2, 2), (0, 1), (0, 0), (0, 0), (0, 0), (2, 2)]
    assert [rate["total"] for rate in by["distance"]["all"]] == [0, 5, 0, 0, 0], "in diagonals of the object"
    assert "sun_elevation" not in by, "what is not known is left out"


@pytest.mark.parametrize("name", CONDITIONS)
def test_edges_rise_and_have_names(name: str) -> None:
    edges, bins = CONDITIONS[name].edges, bins_of(name)
    assert all(low < high for low, high in pairwise(edges))
    assert len(bins) == len(edges) - 1
    assert (edges[-1] == float("inf")) == bins[-1].endswith("or more")


def test_what_else_is_reported_counts_objects() -> None:
    truth = picture((HERE, 1))
    twice = reported((HERE, 0.9, "truck"), (HERE, 0.8, "truck"), (HERE, 0.7, "bus"), (THERE, 0.9, "boat"))
    others = measured([twice, reported((HERE, 0.6, "truck"))], [truth, truth])["reported_as"]
    assert others == {"car": {"truck": 2, "bus": 1}}
    assert list(others["car"]) == ["truck", "bus"]
    assert measured([reported()], [truth])["reported_as"] == {}


def test_other_classes_count_detections() -> None:
    looks = [reported((HERE, 0.9, "truck"), (THERE, 0.8, "car"), (THERE, 0.8, "bench")), reported((HERE, 0.5, "bench"))]
    looks += [reported((HERE, 0.4, "kite"))]
    assert measured(looks, [picture()] * 3)["other_classes"] == {"bench": 2, "truck": 1}


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
    wrong = measured([detections], [picture((HERE, 1))])["false_positives"]
    assert {name: count for name, count in wrong["by_class"].items() if name in ("car", "person")} == {
        "car": cars,
        "person": people,
    }
    assert wrong["number"] == cars + people
    assert wrong["pictures_with"]["successes"] == int(cars + people > 0)


def test_pictures_are_counted_and_matched_apart() -> None:
    results = [reported((HERE, 0.9, "car")), reported((THERE, 0.9, "car"), (HERE, 0.8, "person")), reported()]
    wrong = measured(results, [picture((HERE, 1)), picture((HERE, 1)), picture()])["false_positives"]
    assert (wrong["pictures"], wrong["pictures_with"]["successes"], wrong["number"]) == (3, 1, 2)
    assert wrong["per_picture"] == pytest.approx(2 / 3)
    assert wrong["interval"] == [end / 3 for end in poisson_interval(2)]


@pytest.mark.parametrize("count", [0, 1, 2, 7, 60, 400])
def test_the_interval_is_garwood_s(count: int) -> None:
    low, high = poisson_interval(count)
    assert low == pytest.approx(chi2.ppf(0.025, 2 * count) / 2 if count else 0.0, rel=1e-6)
    assert high == pytest.approx(chi2.ppf(0.975, 2 * count + 2) / 2, rel=1e-6)


def test_detectors_are_equally_strict_where_they_have_as_many_false_positives() -> None:
    scores = (0.875, 0.625, 0.625, 0.25)
    least = confidences_at(scores, 5, (0.0, 0.2, 0.4, 0.6, 1.0))
    counted = {name: sum(score >= (floor or 0) for score in scores) for name, floor in least.items()}
    assert counted == {"0": 0, "0.2": 1, "0.4": 1, "0.6": 3, "1": 4}  # of equal ones all or none
    assert least["1"] is None


def test_only_false_positives_of_the_project_s_classes_make_a_detector_strict() -> None:
    kite, right = (HERE, 0.95, "kite"), reported((HERE, 0.8, "car"))
    wrong = [reported((HERE, 0.5, "car"), kite), reported(kite)]
    looked = seen_by([*wrong, right], [picture(), picture(), picture((HERE, 1))], name="background: x")
    record = {"detectors": {"fake_colour": {}}, "sets": {"background: x": 3}, "confidence": 0.5}
    counted = figures(record, {ROWS: looked.rows, DETECTIONS: looked.detections})["detectors"]["fake_colour"]
    assert counted["false_positives"]["all"]["confidence_at"]["0.1"] == pytest.approx(0.5)


# Detectors


def test_a_detector_of_more_classes_is_scored_on_those_of_the_project() -> None:
    pictures = [picture((HERE, SMALL_CLASSES.index("person") + 1)), picture()]
    looks = [reported((HERE, 0.9, "person"), (THERE, 0.9, "bench")), reported((THERE, 0.9, "bus"), (AWAY, 0.9, "car"))]
    mixed = measured(looks, pictures)
    assert mixed["ap"] == {"person": 1.0}
    assert mixed["other_classes"] == {"bench": 1, "bus": 1}
    assert mixed["false_positives"]["number"] == mixed["false_positives"]["by_class"]["car"] == 1
    assert set(mixed["false_positives"]["by_class"]) == set(SMALL_CLASSES)
    assert mixed["found_by"]["elevation"]["all"][3]["successes"] == 1
    assert "car" not in mixed["found_by"]["elevation"], "there is none"
    assert mixed["found_by"]["distance"]["all"][-1]["to"] is None
    assert json.loads(json.dumps(mixed)) == mixed
    without = measured([reported()] * 2, [picture()] * 2)
    assert without["pictures"] == 2
    assert "map" not in without


def test_unlikely_detections_are_kept_where_that_can_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    class Floored(TableDetector):
        def __init__(self) -> None:
            self.min_confidence = 0.25

    made: list[ColourDetector] = [Floored(), TableDetector()]
    monkeypatch.setattr("attacks.detectors.evaluation.load_detector", lambda name, weights: made.pop(0))
    assert load_for_evaluation("floored").min_confidence == 0.001
    assert load_for_evaluation("plain").min_confidence == 0.05, "it cannot be chosen"


def test_a_detector_without_any_of_the_project_s_classes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    detector = ColourDetector()
    monkeypatch.setattr("attacks.detectors.evaluation.load_detector", lambda name, weights: detector)
    load_for_evaluation("few")
    assert lacking(detector) == tuple(label for label in SMALL_CLASSES if label not in ColourDetector.classes)
    detector.classes = ("kite",)
    with pytest.raises(
        DetectorError, match=r"detector few: expected one that knows some of car, .*got one that knows none"
    ):
        load_for_evaluation("few")


def test_objects_of_a_class_that_a_detector_lacks_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it reports on them is."""
    detector = TableDetector(reported((HERE, 0.9, "car"), (THERE, 0.8, "car")))
    monkeypatch.setattr(detector, "classes", ("car",))
    looked = look_at(detector, {"": [picture((HERE, 1), (THERE, 2))]})
    assert looked.rows["original"].to_list() == ["car"]
    result = set_figures(looked.rows, with_right(looked.rows, looked.detections), 1, 0.5)
    assert result["ap"] == {"car": 1.0}
    assert result["false_positives"]["by_class"]["car"] == 1


# Results


def test_totals_leave_out_scenes_of_the_user() -> None:
    totals = evaluated()[0]["detectors"]["one"]["false_positives"]
    assert {name: (wrong["number"], wrong["pictures"]) for name, wrong in totals.items()} == {
        "with objects": (3, 4),
        "without objects": (2, 16),
        "all": (5, 20),
    }
    assert (totals["all"]["by_class"]["car"], totals["all"]["by_class"]["tv"]) == (0, 5)
    assert totals["without objects"]["pictures_with"]["successes"] == 2


def test_every_figure_follows_from_the_rows_that_are_kept(tmp_path: Path) -> None:
    record, looked = evaluated("one", "two")
    save_json(record, tmp_path / "result.json")
    looked.write(tmp_path)
    write_manifest(tmp_path)
    result = read_result(tmp_path)
    assert all(check.passed for check in [*check_figures(result, figures), *check_detections(result)])
    assert figures(record, {name: read_rows(tmp_path / f"{name}.csv.gz") for name in (ROWS, DETECTIONS)})


def test_the_tables_of_a_detector_hold_its_figures() -> None:
    text = "\n\n".join(table.markdown for table in tables(documents(evaluated()[0])))
    half = "2 of 4 = 50\u00a0% (15 to 85\u00a0%)"
    assert f"| path traced | car | 0.500 | {half} | truck 1 |" in text
    assert f"| scenes/x.xml | car | 0.500 | {half} | truck 1 |" in text
    assert f"| 45 to 60 | {half} | {half} |" in text, "of all objects, and of cars"
    assert "| 0 to 15 | - | - |" in text
    assert "| background: street | 0.25 (2 in 8; 0.03 to 0.90) | 2 of 8 = 25\u00a0% " in text
    assert "| together, without objects | 0.12 (2 in 16; 0.02 to 0.45) | 2 of 16 = 12.5\u00a0% " in text
    assert "| path traced | kite 1, truck 1 |" in text
    for condition in CONDITIONS:
        assert f"Found by {condition.replace('_', ' ')}, " in text


def test_detectors_side_by_side() -> None:
    record, _ = evaluated("one", "two", confidence=0.3)
    text = "\n\n".join(table.markdown for table in tables(documents(record)))
    row = "0.500 | 0.75 (3 in 4; 0.15 to 2.19) | 0.25 (2 in 8; 0.03 to 0.90) | 0.12 (2 in 16; 0.02 to 0.45) |"
    assert f"| one at 0.3 | {row}" in text
    assert text.count("| two at 0.3 | ") == 3, "and recall of objects and of cars"
    assert "splat renders" not in text, "no detector has seen any"
    assert "## two at 0.3: By class" in text


# Commands


@pytest.mark.slow
def test_the_command_scores_pictures_backgrounds_and_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = asdict(BackgroundConfig(scenes=1, shots=2, samples=1, size=64))
    flags = [f"--backgrounds.{name}={sizes[name]}" for name in ("scenes", "shots", "samples", "size")]
    words = ["evaluate-detector", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out"), *flags]
    words += ["--pictures=3", "--samples=1", "--splats=0", "--processes=0"]
    words += ["--scenes", "scenes/car_street.xml", "scenes/stop_sign.xml"]
    assert cli.main([*words, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record == json.loads((tmp_path / "out" / "result.json").read_text())
    shown = record["detectors"]["fasterrcnn_small"]
    assert set(shown["sets"]) == {
        "path traced",
        "scenes/car_street.xml",
        "scenes/stop_sign.xml",
        *(f"background: {k}" for k in BACKGROUNDS),
    }
    street = shown["sets"]["scenes/car_street.xml"]
    assert street["pictures"] == 6
    assert (street["found"]["car"]["successes"], street["found"]["car"]["total"]) == (6, 6)
    assert shown["sets"]["scenes/stop_sign.xml"]["found"]["stop sign"]["rate"] == 1.0
    assert len(shown["fingerprint"]) == 16
    assert shown["sets"]["path traced"]["found_by"]["elevation"]["all"]
    assert record["pictures"]["backgrounds"]["scenes"] == 1
    result = read_result(tmp_path / "out")
    assert all(check.passed for check in [*check_figures(result, figures), *check_detections(result)])
    assert len(rows(tmp_path / "out")) >= 12
    assert cli.main([*words, "--force"]) == 0
    assert "| background: street | " in capsys.readouterr().out
