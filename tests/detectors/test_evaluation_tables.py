"""The tables and the picture that `evaluate-detector` and `compare-detectors` write."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attacks import cli
from attacks.detectors.evaluation.held_out import HeldOutResult, figures, total_false_positives
from attacks.detectors.evaluation.plots import draw_recall
from attacks.detectors.evaluation.recall import CONDITIONS, ObjectResult
from attacks.detectors.evaluation.tables import comparison, detector_tables, read_figures
from attacks.detectors.training.average_precision import Score
from attacks.detectors.training.false_positives import FalsePositives
from mi_splat.errors import InvalidValueError

SEEN = {"elevation": 50.0, "distance": 3.0, "size": 0.3, "brightness": 0.35, "sun_elevation": 20.0, "sun_strength": 2.0}


def objects(*, found: int, of: int) -> tuple[ObjectResult, ...]:
    return tuple(
        ObjectResult(label="car", found=number < found, reported_as=("truck",) if number == 0 else (), seen=SEEN)
        for number in range(of)
    )


def false(total: int, pictures: int) -> FalsePositives:
    return FalsePositives(pictures=pictures, pictures_with=min(total, pictures), by_class={"car": 0, "tv": total})


def document(name: str = "one", *, confidence: float = 0.5) -> dict[str, Any]:
    score = Score(ap={"car": 0.75}, recall={"car": 0.5}, counts={"car": 4})
    results = {
        "path traced": HeldOutResult(
            score=score, false_positives=false(3, 4), objects=objects(found=2, of=4), other_classes={"kite": 2}
        ),
        "background: street": HeldOutResult(score=None, false_positives=false(2, 8), other_classes={}),
        "background: park": HeldOutResult(score=None, false_positives=false(0, 8), other_classes={}),
        "scenes/x.xml": HeldOutResult(
            score=score, false_positives=false(9, 1), objects=objects(found=2, of=4), other_classes={}
        ),
    }
    return {
        "detector": name,
        "fingerprint": "0" * 16,
        "min_confidence": 0.05,
        "confidence": confidence,
        "false_positives": total_false_positives(results),
        "sets": figures(results),
    }


def test_totals_leave_out_scenes_of_the_user() -> None:
    totals = document()["false_positives"]
    assert {name: (one["total"], one["pictures"]) for name, one in totals.items()} == {
        "with objects": (3, 4),
        "without objects": (2, 16),
        "all": (5, 20),
    }
    assert totals["all"]["by_class"] == {"car": 0, "tv": 5}
    assert totals["without objects"]["pictures_with"] == 2


def test_the_tables_of_a_detector_hold_its_figures() -> None:
    text = detector_tables(document())
    assert "| car | 0.75 | 4 | 50 % |" in text
    assert "| person | - | 0 | - |" in text
    assert "| **mean** | **0.750** | 4 in 4 pictures |  |" in text
    assert "| 45 to 60 | 50 % (2/4; 15 to 85) | 50 % (2/4; 15 to 85) |" in text, "of all objects, and of cars"
    assert "| 0 to 15 | - | - |" in text
    assert "| scenes/x.xml | car | 4 | 50 % | 0.75 |" in text
    assert "| background: street | 0.25 (2/8; 0.03 to 0.90) | 2/8 | tv 2 |" in text
    assert "| **together, without objects** | 0.12 (2/16; 0.02 to 0.45) | 2/16 | tv 2 |" in text
    assert "| car | of 4: truck 1 | of 0: nothing |" in text
    assert "| path traced | 4 | kite 2 |" in text
    for condition in CONDITIONS:
        assert f"**{condition.replace('_', ' ')}**" in text


def test_a_detector_of_no_other_classes_has_no_such_table() -> None:
    found = document()
    found["sets"]["path traced"]["other_classes"] = {}
    assert "other classes" not in detector_tables(found)


def test_detectors_side_by_side() -> None:
    text = comparison([document("one"), document("two")])
    assert (
        "| `one` | 0.750 | - | 0.75 (3/4; 0.15 to 2.19) | 0.25 (2/8; 0.03 to 0.90) | 0.12 (2/16; 0.02 to 0.45) |"
        in text
    )
    assert text.count("| `two` | ") == 3, "and recall of objects and of cars"
    assert "splat renders:" not in text, "no detector has seen any"
    assert "cars, path traced and splat renders together:" in text


def test_another_confidence_is_named() -> None:
    text = comparison([document("one"), document("two", confidence=0.3)])
    assert "| `one` |" in text
    assert "| `two` at 0.3 |" in text
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


@pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib (extra figures)")
def test_a_line_for_each_detector_or_each_set() -> None:
    several = [document("one"), document("two"), document("three")]
    axes = draw_recall(several).axes[0]
    assert [line.get_label() for line in axes.containers] == ["one at 0.5", "two at 0.5", "three at 0.5"]
    assert np.asarray(axes.get_lines()[0].get_ydata()).tolist() == [0.5], "empty bins are left out"
    single = draw_recall(several[:1]).axes[0]
    assert [line.get_label() for line in single.containers] == ["path traced"]


def test_the_command_compares_and_writes_beside(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [tmp_path / f"{name}.json" for name in ("one", "two")]
    for path in paths:
        path.write_text(json.dumps(document(path.stem)))
    out = tmp_path / "new" / "both.md"
    assert cli.main(["compare-detectors", *map(str, paths), "--out", str(out)]) == 0
    assert out.read_text() == comparison([document("one"), document("two")])
    assert "| `two` |" in capsys.readouterr().out
    assert out.with_suffix(".png").is_file() == (importlib.util.find_spec("matplotlib") is not None)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["compare-detectors"], "files: expected at least one, got none"),
        (["compare-detectors", "{}/one.json", "--out", "{}/x.json"], "a file name that ends in .md"),
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
