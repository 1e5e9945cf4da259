"""Attacks side by side: the table of a study of several optimisers."""

import json
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.studies.result import AXIS, tables
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


@pytest.fixture
def record(tmp_path: Path, toys: None) -> dict[str, Any]:
    """result.json of a study of three optimisers."""
    path = tmp_path / "toy.toml"
    path.write_text(STUDY.format(scene=write_toy(tmp_path)))
    words = [
        "study",
        "run",
        str(path),
        "--store",
        str(tmp_path / "store"),
        "--workers",
        "0",
    ]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    document: dict[str, Any] = json.loads(
        (tmp_path / "out" / "result.json").read_text()
    )
    return document


def test_the_table_has_a_line_for_each_attack_and_says_what_it_cost(
    record: dict[str, Any],
) -> None:
    (table,) = tables(record)
    assert table.caption.startswith("Attacks side by side")
    assert table.head == (
        *("attack", "0.5", "12.0", "together", "random noise", "looks", "CPU seconds"),
    )
    lines = {row[0]: row for row in table.rows}
    assert lines["pgd"][2].startswith("1/1 (")
    assert [lines[name][5] for name in ("pgd", "fgsm", "square")] == ["7", "2", "7"]
    assert all(float(row[6].split(" (")[0]) > 0 for row in table.rows)
    assert lines["pgd"][3] == "1/2 (0.09 to 0.91)"
    assert lines["pgd"][4] == "0/2"
    pgd = next(
        one
        for one in record["groups"]
        if one["labels"] == {AXIS: "pgd", "attack.eps": 0.5}
    )
    assert lines["pgd"][1] == f"{pgd['success']['successes']}/1 ({pgd['loss']:.2f})"
