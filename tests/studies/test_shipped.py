"""The studies in scenes/studies can be done, and ask what they always asked."""

import runpy
from pathlib import Path

import pytest

from attacks.studies import dagger
from attacks.studies.dagger import DaggerAttempt, DaggerWork
from attacks.studies.study_file import read_study
from tests.project.layers import ROOT

SHIPPED = [
    path
    for path in sorted((ROOT / "scenes" / "studies").glob("*.toml"))
    if not path.stem.startswith(("cloak", "audit", "poison", "m_ifgsm"))
]
JOBS = {
    "attack_zoo": (225, 0),
    "between_renderers": (54, 432),
    "coco": (72, 0),
    "coco_demo": (12, 0),
    "coco_smallest": (252, 0),
    "dagger": (456, 0),
    "dagger_strict": (96, 0),
    "dagger_strict_forty": (27, 0),
    "dagger_strict_smallest": (306, 0),
    "eot_pairs": (14, 0),
    "eot_settings": (38, 0),
    "eot_smallest": (66, 0),
    "eot_views": (6, 24),
    "files": (48, 480),
    "gradients": (66, 66),
    "openimages": (48, 240),
    "pairs": (6, 0),
    "sun": (12, 72),
    "transfer": (144, 576),
}
"""Attacks and looks of each study, those of searches that may never be asked for, too."""


@pytest.fixture(autouse=True)
def _anywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths are those of the checkout, and weights that were not fetched are not missed."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(dagger, "weights", lambda detectors: {})


def attempts(name: str) -> list[DaggerAttempt]:
    return DaggerWork(read_study(ROOT / "scenes" / "studies" / f"{name}.toml")).attempts


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_study_is_so_many_jobs(path: Path) -> None:
    done = attempts(path.stem)
    assert (len(done), sum(len(one.looks) for one in done)) == JOBS[path.stem]
    assert len({one.title for one in done}) == len(done)
    assert read_study(path).question.endswith("?")
    for one in done:
        sensors = (ROOT / str(one.job.inputs["scene"])).read_text()
        assert f'<shape type="gaussians" id="{one.job.config.object}">' in sensors
        assert getattr(one.job.config, "camera", 0) < sensors.count("<sensor ")


# The tables of the rendering studies in the documentation are counted from their rows, one for each look at each attack


TABLES = ROOT / "docs" / "tables"
STUDY_TABLES = runpy.run_path(str(ROOT / "docs" / "sphinx_extensions" / "study_tables.py"))


@pytest.mark.parametrize(
    ("name", "attacks", "line"),
    [
        ("between_renderers", 54, "| tile | 8/9 (0.57 to 0.98) | 1/9 (0.02 to 0.43) | 0/9 (0.00 to 0.30) |"),
        ("gradients", 66, "| tile | 6/6 (0.61 to 1.00) | 5/6 (0.44 to 0.97) | 3/6 (0.19 to 0.81) |"),
        ("files", 48, "| .splat | 0/12 (0.00 to 0.24) | 0/12 (0.00 to 0.24) | 0/12 (0.00 to 0.24) |"),
        ("sun", 12, "| 07:00 | 3/5 (0.23 to 0.88) | 0/5 |"),
    ],
)
def test_tables_of_the_rendering_studies_are_counted_from_their_rows(name: str, attacks: int, line: str) -> None:
    text = STUDY_TABLES["page"](name, TABLES)
    assert f"{attacks} attacks: " in text
    assert line in text
    conclusions = (ROOT / "docs" / "rendering-studies.md").read_text()
    assert f"](tables/study_{name}.md)" in conclusions
