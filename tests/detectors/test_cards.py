"""The cards of the shipped detectors say what was measured, and of the weights that are
shipped.
"""

import importlib.util
import json
import runpy
from pathlib import Path

import pytest

from attacks.detectors import DETECTORS, load_detector
from scenes.recipes.detector_pictures import BACKGROUNDS, EMPTY

pytestmark = pytest.mark.shipped

ROOT = Path(__file__).resolve().parents[2]
WRITER = runpy.run_path(str(ROOT / "docs" / "figures" / "detector_figures.py"))
"""The program that writes the tables."""
read_figures = WRITER["read_figures"]
card_of = WRITER["card_of"]
compared = WRITER["compared"]
CARDS: dict[str, tuple[Path, Path]] = WRITER["CARDS"]


@pytest.mark.parametrize("name", CARDS)
def test_a_card_holds_the_measured_tables(name: str) -> None:
    figures, card = CARDS[name]
    document = read_figures(figures)
    assert document["detector"] == name
    assert card_of(document, WRITER["OF_CARDS"]).strip() in card.read_text()
    assert {f"{EMPTY}{kind}" for kind in BACKGROUNDS} <= set(document["sets"])
    assert document["sets"]["path traced"]["pictures"] == 240


@pytest.mark.parametrize("name", CARDS)
def test_they_are_of_the_weights_that_are_shipped(name: str) -> None:
    absent = [
        package
        for package in DETECTORS[name].requires
        if importlib.util.find_spec(package) is None
    ]
    if absent:
        pytest.skip(f"needs {', '.join(absent)}")
    assert (
        load_detector(name).fingerprint == read_figures(CARDS[name][0])["fingerprint"]
    )


def test_the_page_of_detectors_holds_the_same_figures() -> None:
    files: list[Path] = WRITER["kept_figures"]()
    page = (ROOT / "docs" / "detectors.md").read_text()
    assert len(files) > len(CARDS)
    several = [read_figures(path) for path in files]
    assert WRITER["in_markdown"]([WRITER["in_short"](several)]) in page
    assert WRITER["in_markdown"](compared(several)) in WRITER["compared_page"]()
    for path in files[len(CARDS) :]:
        own = WRITER["table_page"](path)
        assert own.startswith(
            f"# {read_figures(path)['detector']}, from a confidence of "
        )
        assert own.endswith(card_of(read_figures(path)))


def test_new_figures_find_their_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    card = tmp_path / "card.json"
    card.write_text('{"history": [1]}')
    namespace = WRITER["put_away"].__globals__
    monkeypatch.setitem(namespace, "CARDS", {"fasterrcnn_small": (card, card)})
    monkeypatch.setitem(namespace, "TABLES", tmp_path / "tables")
    sets: dict[str, object] = {"path traced": {"pictures": 3}}
    record = {
        "detectors": {name: {"sets": sets} for name in ("fasterrcnn_small", "other")}
    }
    for confidence in (0.5, 0.3):
        made: dict[str, object] = {"pictures": {}, "versions": {}, "commit": None}
        (tmp_path / "result.json").write_text(
            json.dumps({**record, **made, "confidence": confidence})
        )
        WRITER["put_away"](tmp_path / "result.json")
    kept = json.loads(card.read_text())
    assert kept["history"] == [1]
    assert kept["held_out"]["sets"] == sets
    names = ["fasterrcnn_small_30.json", "other.json", "other_30.json"]
    assert sorted(path.name for path in (tmp_path / "tables").iterdir()) == names
