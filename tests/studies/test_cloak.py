"""`study = "cloak"`: what a point is, that points share what they can, and the tables
of what they find.
"""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from attacks import cli
from attacks.cloak.study import study_toml
from attacks.observe.rows import read_rows
from attacks.report.checking import check_detections, read_result
from attacks.report.kinds import cloak
from attacks.report.results import read_section
from attacks.studies.cloak import tables
from mi_splat.ledger import Store
from tests.cloak.tiny_study import STUDY, known
from tests.project.layers import ROOT
from tests.report.results import cloak_record, rate

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
        ' 10.0]\n[judge]\nevery = 4\n[judge.matrix]\ncondition = ["SH of degree 0", "2'
        ' x distance"]\n'
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
    point = record["points"]["inside: 10.0"]
    seeds = [seed["redness"]["benign_recall"] for seed in point["by_seed"].values()]
    assert len(seeds) == 2
    for key in ("successes", "total"):
        assert point["by_detector"]["redness"]["benign_recall"][key] == sum(
            seed[key] for seed in seeds
        )
    rows = {
        name: read_rows(out / f"{name}.csv.xz")
        for name in ("rows", "fidelity", "transition")
    }
    derived = json.loads(json.dumps(cloak.study_figures_of_points(record, rows)))
    for title, figures in derived["points"].items():
        assert figures == {key: record["points"][title][key] for key in figures}
    assert (
        sum("| 5.0 | " in line for line in (out / "table.md").read_text().splitlines())
        == 4
    )
    count = len(rows["rows"])
    assert [check.words for check in check_detections(read_result(out))] == [
        f"give the scores of {count:,} of {count:,} rows"
    ]
    section = read_section(out)
    assert section.title == "tiny, varied"
    assert section.done.endswith(
        "Both splats were then looked at under 2 other conditions."
    )
    looks = {look["condition"]: look for look in point["looks"]}
    assert list(looks) == ["SH of degree 0", "2 x distance"]
    assert (
        set(looks["2 x distance"]["psnr"].values())
        == set(looks["SH of degree 0"]["psnr"].values())
        == {None}
    )
    assert (
        0
        < looks["2 x distance"]["found_clean"]["total"]
        < point["by_detector"]["redness"]["control_benign_recall"]["total"]
    )
    under = next(
        table
        for table in section.tables
        if table.caption == "By inside: under other conditions"
    )
    assert [row[:3] for row in under.rows] == [
        (value, condition, "redness")
        for value in ("5.0", "10.0")
        for condition in looks
    ]
    assert "Under SH of degree 0 and 2 x distance it is missed" in section.conclusion


def test_tables_have_intervals_and_what_is_lost(tmp_path: Path) -> None:
    record = cloak_record()
    several = {
        **record,
        "seeds": [0, 1, 2],
        "gaussians": {"clean": [1000, 1100, 1200], "cloaked": [9] * 3},
    }
    names = list(record["by_detector"])
    seeds = {
        str(seed): {name: {"trigger_miss_rate": rate(seed, 10)} for name in names}
        for seed in range(3)
    }
    quiet = {
        **record,
        "stealth": {"surroundings_psnr_drop": 0.284, "stealthy": True},
        "by_seed": seeds,
    }
    unseen = {
        **record,
        "stealth": None,
        "transition_degrees": None,
        "benign_psnr_drop": None,
    }
    unseen["benign_psnr"] = {"clean": None, "cloaked": None}
    results = {
        "cleaning": {"nothing": several, "SH degree 0": quiet, "SH 5 bits": unseen}
    }
    rates, costs = tables(results)
    assert len(rates.rows) == 3 * len(names)
    assert rates.head[4] == "nothing of any class reported"
    assert rates.rows[0][3].startswith("139 of 139 = 100\u00a0% (87.1 to 100\u00a0%)")
    assert rates.rows[len(names)][3].endswith("; by seed 0\u00a0% to 20\u00a0%")
    assert [" | ".join(row) for row in costs.rows] == [
        "nothing | 3 | 9.7 | 34.50 | 1.19 | 4.45 | - | no | 1,100 | 9",
        "SH degree 0 | 1 | 9.7 | 34.50 | 1.19 | 0.28 | - | yes | 39,995 | 55,072",
        "SH 5 bits | 1 | - | - | - | - | - | - | 39,995 | 55,072",
    ]
