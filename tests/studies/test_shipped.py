"""The studies in scenes/studies can be done, and ask what they always asked."""

import runpy
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from attacks.limits import NORM_NAMES
from attacks.optimisers.registry import OPTIMISERS
from attacks.studies import dagger
from attacks.studies.dagger import DaggerWork
from attacks.studies.result import Attempt
from attacks.studies.study_file import read_study
from attacks.transformations.config import PictureChanges
from mi_splat.attributes import ATTRIBUTES
from tests.project.layers import ROOT

SHIPPED = [
    path
    for path in sorted((ROOT / "scenes" / "studies").glob("*.toml"))
    if not path.stem.startswith(("cloak", "audit", "poison", "m_ifgsm"))
]
PAIRS = {
    *(("car", target) for target in ("person", "elephant", "stop sign")),
    *(("stop_sign", target) for target in ("tv", "train", "bird")),
}
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


def attempts(name: str) -> list[Attempt]:
    return DaggerWork(read_study(ROOT / "scenes" / "studies" / f"{name}.toml")).attempts


def part(name: str, title: str) -> list[Any]:
    return [attempt.job.config.attack for attempt in attempts(name) if attempt.point.part.startswith(title)]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_study_is_so_many_jobs(path: Path) -> None:
    done = attempts(path.stem)
    assert (len(done), sum(len(one.looks) for one in done)) == JOBS[path.stem]
    assert len({one.label for one in done}) == len(done)
    assert read_study(path).question.endswith("?")
    for one in done:
        sensors = (ROOT / one.scene).read_text()
        assert f'<shape type="gaussians" id="{one.job.config.object}">' in sensors
        assert getattr(one.job.config, "camera", 0) < sensors.count("<sensor ")


def test_dagger_holds_what_the_paper_leaves_open() -> None:
    jobs = attempts("dagger")
    aims: dict[str, set[Any]] = {}
    for config in (one.job.config for one in jobs):
        aims.setdefault(config.objective.name, set()).add((config.object, config.objective.label))
    assert aims["relabel"] == PAIRS
    assert aims["hide"] == {("car", None), ("stop_sign", None)}
    paper = part("dagger", "The paper's six pairs")
    assert Counter(config.seed for config in paper) == {0: 6, 1: 6, 2: 6}
    assert {(config.eps, config.norm, config.steps, config.attributes) for config in paper} == {
        ((5.0,), "l2", 11, ("sh",))
    }
    assert {config.eps for config in part("dagger", "Smaller balls")} == {(0.5,), (1.0,), (2.0,)}
    configs = [one.job.config.attack for one in jobs]
    assert {config.attributes for config in configs} == {(name,) for name in ATTRIBUTES}
    assert {config.norm for config in configs} == set(NORM_NAMES)
    cameras = {one.job.config.camera for one in jobs if getattr(one.job.config, "views", 0) == 1}
    assert cameras == set(range(6))
    assert all((ROOT / one.scene).read_text().count("<sensor ") == 6 for one in jobs)


def test_transfer_attacks_each_detector_and_all_but_one() -> None:
    jobs = attempts("transfer")
    names = {name for one in jobs for name in one.job.config.detectors}
    single = {one.job.config.detectors for one in jobs if len(one.job.config.detectors) == 1}
    others = {frozenset(one.job.config.detectors) for one in jobs} - {frozenset(one) for one in single}
    assert single == {(name,) for name in names}
    assert others == {frozenset(names - {name}) for name in names}
    assert all(not one.job.config.attack.early_stop and not one.job.config.attack.noise_draws for one in jobs)
    assert {look.config.detector for one in jobs for look in one.looks.values()} == names


def test_the_searches_on_coco_detectors_are_the_strong_one() -> None:
    for name in ("coco", "coco_demo", "coco_smallest"):
        for one in attempts(name):
            config, objective = one.job.config.attack, one.job.config.objective
            assert (config.step_factor, config.momentum, config.schedule, config.gradient_power) == (
                6.0,
                0.5,
                "cosine",
                0.7,
            )
            aim = (objective.near, objective.top, objective.tightness, objective.suppression, objective.confidence)
            assert aim == (0.85, 1, 0.0, 0.3, 0.5)


def test_the_zoo_compares_every_attack_at_equal_steps_and_in_the_time_of_pgd() -> None:
    points = [one for one in attempts("attack_zoo") if one.point.part == "car to person"]
    configs = {str(one.point.labels["attack.optimiser"]): one.job.config.attack for one in points}
    equal = {name: config for name, config in configs.items() if config.steps == 40 and config.restarts == 1}
    assert set(OPTIMISERS) < set(equal)
    timed = {config.optimiser for name, config in configs.items() if name not in equal}
    assert timed == {"fgsm", *(name for name, spec in OPTIMISERS.items() if not spec.gradient)}
    assert Counter(one.job.config.attack.seed for one in points) == {0: 72, 1: 72, 2: 72}
    assert not any(one.job.config.attack.early_stop for one in attempts("attack_zoo"))
    assert {config.optimiser for config in part("attack_zoo", "car to person, 160")} == {"pgd", "apgd", "cw"}


def test_settings_of_attacks_from_all_around_change_one_at_a_time() -> None:
    assert {config.pool for config in part("eot_settings", "Number of views")} == {1, 8, 64, 0}
    assert {config.sh_degree for config in part("eot_settings", "Highest SH degree")} == {0, 1, 2, 3}
    budgets = [config.image_psnr for config in part("eot_settings", "Success over the image budget")]
    assert budgets == [limit + 0.3 for limit in (36, 34, 32, 30, 28, 26)]
    assert all(config.image_psnr is None for config in part("eot_settings", "Success over the radius"))
    compared = part("eot_settings", "Attributes")
    assert {name for config in compared for name in config.attributes} == set(ATTRIBUTES)
    assert Counter(config.image_psnr for config in compared) == {30.3: 8, 26.3: 8}
    changed = [one for one in attempts("eot_settings") if one.point.part.startswith("Pictures that change")]
    assert {
        tuple(part.pictures == PictureChanges() for part in (one.job.config.transformations, one.job.config.judged))
        for one in changed
    } == {*((True, True), (True, False), (False, True), (False, False))}


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
