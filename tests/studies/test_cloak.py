"""`study = "cloak"`: what a point is, that points share what they can, and the tables
of what they find.
"""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from attacks import cli
from attacks.cloak.study import study_toml
from attacks.figures.frame import (
    MEASURE,
    Figures,
    Number,
    key_of,
    read_figures,
)
from attacks.figures.rate import Rate
from attacks.figures.result import read_result
from attacks.observe.rows import read_rows
from attacks.report.checking import check_detections, check_figures
from attacks.report.results import kind_of, read_section
from attacks.studies.cloak_figures import tables
from mi_splat.ledger import Store
from tests.cloak.tiny_study import STUDY, known
from tests.project.layers import ROOT
from tests.report.results import ARTIFACTS, FAILED

STREET = str(ROOT / "scenes" / "mixed" / "car_among_meshes.xml")


@pytest.mark.slow
def test_points_share_what_they_can_and_take_every_seed(tmp_path: Path) -> None:
    """An evaluation needs no training of its own, so that two points have the trainings
    of one.
    """
    (tmp_path / "base.toml").write_text(
        study_toml(asdict(replace(STUDY, attack=STUDY.attack[:1])))
    )
    file = tmp_path / "tiny.toml"
    file.write_text(
        f'study = "cloak"\nbase = "{tmp_path / "base.toml"}"\nseeds = [0, 1]\ntraining'
        " = { iterations = 12, sh_degree = 0 }\n[[case]]\nname ="
        ' "inside"\n[case.matrix]\n"evaluation.well_inside" = [5.0,'
        " 10.0]\n[evaluate_with]\nevery = 4\n[evaluate_with.matrix]\ncondition ="
        ' ["SH of degree 0", "2 x distance"]\n'
    )
    out = tmp_path / "out"
    store = tmp_path / "store"
    words = [
        "study",
        "run",
        str(file),
        "--store",
        str(store),
        "--out",
        str(out),
        "--workers",
        "0",
    ]
    with known():
        assert cli.main(words) == 0
    records = map(Store(store).record, Store(store).keys())
    assert sum(record["kind"].endswith(".trained") for record in records) == 4
    record = json.loads((out / "result.json").read_text())
    assert list(record["points"]) == ["inside: 5.0", "inside: 10.0"]
    figures = read_figures(out)
    point = figures.where(part="inside", setting="10.0", detector="redness")
    recall = point.rate("benign_recall")
    seeds = [point.rate("benign_recall", seed=seed) for seed in (0, 1)]
    assert recall.successes == sum(rate.successes for rate in seeds)
    assert recall.total == sum(rate.total for rate in seeds) > 0
    result = read_result(out)
    checks = check_figures(result, kind_of(result).derive)
    assert {check.passed for check in checks} == {True}
    assert (
        sum("| 5.0 | " in line for line in (out / "table.md").read_text().splitlines())
        == 4
    )
    count = len(read_rows(out / "rows.csv.xz"))
    assert [check.words for check in check_detections(read_result(out))] == [
        f"give the scores of {count:,} of {count:,} rows"
    ]
    section = read_section(out)
    assert section.title == "tiny, varied"
    assert section.done.endswith(
        "Both splats were then evaluated under 2 other conditions."
    )
    conditions = point.labels("condition")
    assert conditions == ["SH of degree 0", "2 x distance"]
    assert not {"psnr_missed", "psnr_found"} & set(point.labels(MEASURE))
    far = point.rate("found", condition="2 x distance", splat="clean")
    assert 0 < far.total < point.rate("control_benign_recall").total
    under = next(
        table
        for table in section.tables
        if table.caption == "By inside: under other conditions"
    )
    assert [row[:3] for row in under.rows] == [
        (value, condition, "redness")
        for value in ("5.0", "10.0")
        for condition in conditions
    ]
    assert "Under SH of degree 0 and 2 x distance it is missed" in section.conclusion


def with_changes(figures: Figures, **changes: float | None) -> Figures:
    """Figures of a study with some numbers changed, or left out."""
    by_key = dict(figures)
    for measure, value in changes.items():
        for key in figures.by_key:
            if dict(key)[MEASURE] == measure:
                del by_key[key]
        if value is not None:
            by_key[key_of({MEASURE: measure})] = Number(value=value)
    return Figures(by_key)


def test_tables_have_intervals_and_what_is_lost() -> None:
    shipped = read_figures(ARTIFACTS / FAILED)
    names = ("fasterrcnn_small", "yolov8n_small")
    missed = {MEASURE: "trigger_miss_rate"}
    seeds = Figures.of(
        ({**missed, "detector": name, "seed": seed}, Rate(successes=seed, total=10))
        for seed in range(3)
        for name in names
    )
    sizes = Figures.of(
        ({MEASURE: "gaussians", "splat": "clean", "seed": seed}, 1000 + 100 * seed)
        for seed in range(3)
    )
    values = {
        "nothing": Figures.together([shipped, sizes]),
        "SH degree 0": Figures.together(
            [with_changes(shipped, surroundings_psnr_drop=0.284, stealthy=1), seeds]
        ),
        "SH 5 bits": with_changes(
            shipped,
            surroundings_psnr_drop=None,
            object_psnr_drop=None,
            stealthy=None,
            transition_degrees=None,
            benign_psnr_drop=None,
            benign_psnr=None,
        ),
    }
    study = Figures.together(
        figures.labelled(part="cleaning", setting=value)
        for value, figures in values.items()
    )
    rates, costs = tables(study)
    assert len(rates.rows) == 3 * len(names)
    assert rates.head[4] == "nothing of any class reported"
    assert rates.rows[0][3].startswith("139 of 139 = 100\u00a0% (87.1 to 100\u00a0%)")
    assert rates.rows[len(names)][3].endswith("; by seed 0\u00a0% to 20\u00a0%")
    assert [" | ".join(row) for row in costs.rows] == [
        "nothing | 3 | 9.7 | 34.50 | 1.19 | 4.45 | - | no | 1,100 | 55,072",
        "SH degree 0 | 3 | 9.7 | 34.50 | 1.19 | 0.28 | - | yes | 39,995 | 55,072",
        "SH 5 bits | 1 | - | - | - | - | - | - | 39,995 | 55,072",
    ]
