"""The cards of the shipped detectors say what was measured, and of the weights that are shipped."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from attacks.detectors import DETECTORS, load_detector
from attacks.detectors.evaluation.held_out import BACKGROUND
from attacks.detectors.evaluation.tables import comparison, detector_tables, read_figures
from attacks.detectors.training.config import BACKGROUNDS

ROOT = Path(__file__).resolve().parents[2]
CARDS = {
    "fasterrcnn_small": ("attacks/detectors/fasterrcnn_small.json", "attacks/detectors/fasterrcnn_small.md"),
    "yolov8n_small": ("scenes/detectors/yolov8n_small.json", "scenes/detectors/README.md"),
}
"""Detector to the file of its figures and its card."""
TABLES = ROOT / "docs" / "tables" / "detectors"
"""Figures of the detectors that have no card here."""


@pytest.mark.parametrize("name", CARDS)
def test_a_card_holds_the_measured_tables(name: str) -> None:
    figures, card = (ROOT / path for path in CARDS[name])
    found = read_figures(figures)
    assert found["detector"] == name
    assert detector_tables(found).strip() in card.read_text()
    assert {f"{BACKGROUND}{kind}" for kind in BACKGROUNDS} <= set(found["sets"])
    assert found["sets"]["path traced"]["pictures"] == 240


@pytest.mark.parametrize("name", CARDS)
def test_they_are_of_the_weights_that_are_shipped(name: str) -> None:
    absent = [package for package in DETECTORS[name].requires if importlib.util.find_spec(package) is None]
    if absent:
        pytest.skip(f"needs {', '.join(absent)}")
    assert load_detector(name).fingerprint == read_figures(ROOT / CARDS[name][0])["fingerprint"]


def test_the_page_of_detectors_holds_the_same_figures() -> None:
    files = [ROOT / figures for figures, _ in CARDS.values()] + sorted(TABLES.glob("*.json"))
    page = (ROOT / "docs" / "detectors.md").read_text()
    assert len(files) > len(CARDS)
    for line in comparison([read_figures(path) for path in files]).splitlines():
        assert line in page
