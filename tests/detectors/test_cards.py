"""The cards of the shipped detectors say what was measured, and of the weights that are shipped."""

from __future__ import annotations

import importlib.util
import json
import runpy
from pathlib import Path

import pytest

from attacks.detectors import DETECTORS, load_detector
from attacks.detectors.evaluation.held_out import BACKGROUND
from attacks.detectors.evaluation.tables import comparison, detector_tables, read_figures
from attacks.detectors.training.config import BACKGROUNDS

ROOT = Path(__file__).resolve().parents[2]
WRITER = runpy.run_path(str(ROOT / "docs" / "figures" / "detector_figures.py"))
"""The program that writes the tables."""
CARDS: dict[str, tuple[Path, Path]] = WRITER["CARDS"]


@pytest.mark.parametrize("name", CARDS)
def test_a_card_holds_the_measured_tables(name: str) -> None:
    figures, card = CARDS[name]
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
    assert load_detector(name).fingerprint == read_figures(CARDS[name][0])["fingerprint"]


def test_the_page_of_detectors_holds_the_same_figures() -> None:
    files: list[Path] = WRITER["kept_figures"]()
    page = (ROOT / "docs" / "detectors.md").read_text()
    assert len(files) > len(CARDS)
    for line in comparison([read_figures(path) for path in files]).splitlines():
        assert line in page
    for path in files[len(CARDS) :]:
        assert detector_tables(read_figures(path)) in path.with_suffix(".md").read_text()


def test_new_figures_find_their_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    card = tmp_path / "card.json"
    card.write_text('{"history": [1]}')
    places = WRITER["put_away"].__globals__
    monkeypatch.setitem(places, "CARDS", {"fasterrcnn_small": (card, card)})
    monkeypatch.setitem(places, "TABLES", tmp_path / "tables")
    found = read_figures(CARDS["fasterrcnn_small"][0])
    for name, confidence in (("fasterrcnn_small", 0.5), ("fasterrcnn_small", 0.3), ("other", 0.5)):
        (tmp_path / "new.json").write_text(json.dumps({**found, "detector": name, "confidence": confidence}))
        WRITER["put_away"](tmp_path / "new.json")
    assert json.loads(card.read_text()) == {"history": [1], "held_out": found}
    assert sorted(path.name for path in (tmp_path / "tables").iterdir()) == ["fasterrcnn_small_30.json", "other.json"]
