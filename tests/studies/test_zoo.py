"""Attacks side by side: the table of a study of several optimisers."""

from pathlib import Path

import pytest

from attacks import cli
from attacks.figures.frame import AXIS, Figures, read_figures
from attacks.observe.rows import ATTACKED
from attacks.studies.result import SETTING
from attacks.studies.tables import OPTIMISER, tables
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
def figures(tmp_path: Path, toys: None) -> Figures:
    """The figures of a study of three optimisers."""
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
    return read_figures(tmp_path / "out")


def test_the_table_has_a_line_for_each_attack_and_says_what_it_cost(
    figures: Figures,
) -> None:
    (table,) = tables(figures)
    assert table.caption.startswith("Attacks side by side")
    assert table.head == (
        "attack",
        "0.5",
        "12",
        "together",
        "random noise",
        "evaluations",
        "CPU seconds",
    )
    lines = {row[0]: row for row in table.rows}
    assert lines["pgd"][2].startswith("1/1 (")
    assert [lines[name][5] for name in ("pgd", "fgsm", "square")] == ["7", "2", "7"]
    assert all(float(row[6].split(" (")[0]) > 0 for row in table.rows)
    assert lines["pgd"][3] == "1/2 (0.09 to 0.91)"
    assert lines["pgd"][4] == "0/2"
    weak = {OPTIMISER: "pgd", f"{AXIS}attack.eps": "0.5"}
    pgd = figures.where(scope=SETTING, **weak)
    reached = pgd.rate("reached", splat=ATTACKED)
    assert lines["pgd"][1] == f"{reached.short()} ({pgd.value('loss'):.2f})"
