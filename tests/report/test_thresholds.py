"""More than one threshold: rates over the confidence from which a detection counts, of rows that are there."""

from __future__ import annotations

import json
from pathlib import Path

from attacks.cloak.rates import measures
from attacks.observe.measures import Confidence, Measures
from attacks.report.stories.cloak import study_of
from attacks.report.stories.thresholds import threshold_charts
from tests.project.layers import ROOT

SECTOR = ROOT / "docs" / "artifacts" / "cloak_car_sector"


def cloak(confidence: Confidence) -> Measures:
    study = study_of(json.loads((SECTOR / "result.json").read_text())["study"])
    return measures(study, confidence=confidence)


def test_the_sector_is_missed_less_by_a_lower_confidence() -> None:
    charts, (table,) = threshold_charts(SECTOR, cloak, {"trigger_miss_rate": ("missed", "attack")})
    assert [chart.title.split(",")[0] for chart in charts][:2] == ["fasterrcnn_small", "yolov8n_small"]
    (line,) = charts[1].lines
    heights = {point.x: point.y for point in line.points}
    assert (round(heights[0.5], 3), round(heights[0.2], 3)) == (0.579, 0.163)
    assert all(point.low is not None and point.low <= point.y <= (point.high or 0) for point in line.points)
    assert table.head == ("detector", "rate", "from 0.5", "from 0.25")
    detector, words, half, quarter = table.rows[1]
    assert (detector, words) == ("yolov8n_small", "missed")
    assert half.startswith("84 of 145")
    assert quarter.startswith("24 of 147")


def test_a_result_without_rows_or_without_such_a_rate_has_none(tmp_path: Path) -> None:
    assert threshold_charts(tmp_path, cloak, {"trigger_miss_rate": ("missed", "attack")}) == ((), ())
    assert threshold_charts(SECTOR, cloak, {"target_rate": ("reported", "attack")}) == ((), ())
