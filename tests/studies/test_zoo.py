"""Attacks side by side: the table of a study of several optimisers, and its signs of doubt."""

import json
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.studies.result import AXIS, comparison, doubts, tables
from tests.studies.toy import write_toy

STUDY = """
study = "dagger"
scene = "{scene}"
object = "car"
target = "person"
detectors = ["fake_colour"]
attack = {{ steps = 6, early_stop = false, noise_draws = 1 }}
[matrix]
"attack.optimiser" = ["pgd", "fgsm", "square"]
"attack.eps" = [0.5, 12.0]
"""


def group(name: str, successes: int, loss: float, noise: int = 0, attribute: str = "sh") -> dict[str, Any]:
    return {
        "part": "",
        "labels": {AXIS: name, "attribute": attribute},
        "optimiser": name,
        "success": {"successes": successes, "total": 2},
        "noise_successes": noise,
        "noise_draws": 2,
        "loss": loss,
        "evaluations": 7,
        "cpu_seconds": 2.0,
    }


@pytest.fixture
def record(tmp_path: Path, toys: None) -> dict[str, Any]:
    """result.json of a study of three optimisers."""
    path = tmp_path / "toy.toml"
    path.write_text(STUDY.format(scene=write_toy(tmp_path)))
    words = ["study", "run", str(path), "--store", str(tmp_path / "store"), "--workers", "0"]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    document: dict[str, Any] = json.loads((tmp_path / "out" / "result.json").read_text())
    return document


def test_the_table_has_a_line_for_each_attack_and_says_what_it_cost(record: dict[str, Any]) -> None:
    table, doubted = tables(record)
    assert table.caption.startswith("Attacks side by side")
    assert table.head == (*("attack", "0.5", "12.0", "together", "random noise", "looks", "CPU seconds"),)
    lines = {row[0]: row for row in table.rows}
    assert lines["pgd"][2].startswith("1/1 (")
    assert [lines[name][5] for name in ("pgd", "fgsm", "square")] == ["7", "2", "7"]
    assert all(float(row[6].split(" (")[0]) > 0 for row in table.rows)
    assert lines["pgd"][3] == "1/2 (0.09 to 0.91)"
    assert lines["pgd"][4] == "0/2"
    assert doubted.head == ("case", "best with gradients", "best of the others", "doubt")
    assert [row[0] for row in doubted.rows] == ["0.5", "12.0"]
    assert [row[1].split(",")[0] for row in doubted.rows] == ["pgd", "pgd"]
    pgd = next(one for one in record["groups"] if one["labels"] == {AXIS: "pgd", "attack.eps": 0.5})
    assert lines["pgd"][1] == f"{pgd['success']['successes']}/1 ({pgd['loss']:.2f})"


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ([group("pgd", 2, 0.1), group("square", 2, 0.05), group("fgsm", 2, 0.01)], []),
        ([group("pgd", 0, 0.4), group("square", 0, 0.5)], []),
        ([group("pgd", 0, 0.4), group("square", 0, 0.3)], ["square, which knows no gradient"]),
        ([group("pgd", 1, 0.4), group("apgd", 2, 0.3), group("square", 2, 0.2)], []),
        ([group("pgd", 1, 0.4), group("fgsm", 2, 0.5)], ["one step does better"]),
        ([group("pgd", 2, 0.4, noise=1), group("random", 0, 0.5)], ["random noise"]),
        ([group("pgd", 0, 0.4, attribute="means"), group("random", 1, 0.5)], []),
    ],
)
def test_what_raises_a_doubt(groups: list[dict[str, Any]], words: list[str]) -> None:
    told = list(doubts(groups))
    assert len(told) == len(words), told
    assert all(word in text for word, text in zip(words, told, strict=True))
    _, *asked = comparison("", [*groups, group("pgd", 0, 9.0, attribute="elsewhere")])
    said = [row[-1] for table in asked for row in table.rows if row[-1] != "none"]
    assert said == [text.partition(" (")[0] for text in told]
