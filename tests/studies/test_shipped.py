"""The studies in scenes/studies can be done, and ask what they always asked."""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from attacks.limits import NORM_NAMES
from attacks.observe.measures import transfer_measures, with_control
from attacks.observe.rates import count
from attacks.observe.rows import read_rows
from attacks.optimisers.registry import OPTIMISERS
from attacks.rate import Rate
from attacks.studies import dagger
from attacks.studies.dagger import DaggerWork
from attacks.studies.result import Attempt
from attacks.studies.study_file import read_study
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
    "attack_zoo": (120, 0),
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


def test_the_zoo_compares_every_attack_at_equal_steps_and_those_without_gradients_at_equal_time() -> None:
    steps, time = part("attack_zoo", "equal steps"), part("attack_zoo", "equal time")
    assert {config.optimiser for config in steps} == set(OPTIMISERS)
    assert {config.optimiser for config in time} == {name for name, spec in OPTIMISERS.items() if not spec.gradient}
    assert {config.steps for config in steps} == {12}
    assert {config.steps for config in time} == {25}
    assert not any(config.early_stop for config in (*steps, *time))


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
        (one.job.config.transformations.pictures.are_none, one.job.config.judged.pictures.are_none) for one in changed
    } == {*((True, True), (True, False), (False, True), (False, False))}


# The tables of the rendering studies in the documentation follow from their rows, one for each look at each attack


TABLES = ROOT / "docs" / "tables"
PAGES = sorted(TABLES.glob("study_*.md"))
KINDS = {
    "The wanted class is reported": "targeted",
    "The object's class is no longer reported": "untargeted",
}
VISIBLE = "How visible the attacks are"


def rows_of(study: str) -> pl.DataFrame:
    """The rows of a study, with the two parts of the attack's name that its tables group by."""
    rows = read_rows(TABLES / "rendering_studies.csv.gz")
    parts = pl.col("attack").str.split("; ")
    rows = rows.with_columns(study=parts.list.get(0), source=parts.list.get(2), ball=parts.list.get(3))
    return rows.filter(study=study)


def tables(page: Path) -> Iterator[tuple[str, list[list[str]]]]:
    """Title and cells of every table of a page."""
    for section in page.read_text().split("\n## ")[1:]:
        lines = [line for line in section.splitlines() if line.startswith("|")]
        yield section.splitlines()[0], [line.strip("| ").split(" | ") for line in lines if "---" not in line]


def said(rate: Rate) -> str:
    low, high = rate.interval
    return f"{rate.successes}/{rate.total} ({low:.2f} to {high:.2f})" if rate.total else "0/0"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_every_rate_follows_from_the_rows(page: Path) -> None:
    rows = rows_of(page.stem.removeprefix("study_"))
    (confidence,) = re.findall(r"a class counts from ([0-9.]*[0-9])\.", page.read_text())
    table = with_control(rows)
    by = ("detector", "source", "ball", "condition")
    counted = count(table, transfer_measures(float(confidence)), by)
    checked = 0
    for title, (head, *body) in tables(page):
        if title == VISIBLE:
            medians = rows.group_by("detector", "source", "ball").agg(pl.col("psnr").median())
            psnr = {tuple(group): f"{value:.1f}" for *group, value in medians.iter_rows()}
            assert {tuple(line[:3]): line[3] for line in body} == psnr
            continue
        what, detector = title.split(": ")
        kind = KINDS[what]
        for condition, *cells, noise in body:
            drawn = []
            for column, cell in zip(head[1:-1], cells, strict=True):
                source, ball = column.split(": ")
                found = counted.get((detector, source, ball, condition))
                assert cell == ("-" if found is None else said(found[kind])), (title, condition, column)
                drawn += [] if found is None else [found[f"noise_{kind}"]]
                checked += 1
            total = f"{sum(rate.successes for rate in drawn)}/{sum(rate.total for rate in drawn)}"
            assert noise == total
    assert checked >= 2 * len(counted)
