"""`study = "cloak"`: what a point is, that points share what they can, and the tables of what they find."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import pytest

from attacks import cli
from attacks.cloak.config import StudyConfig, read_study, study_toml
from attacks.cloak.study import forecast
from attacks.detectors import registry
from attacks.observe.rows import read_rows
from attacks.report.checking import check_detections, read_result
from attacks.report.results import read_section
from attacks.report.stories import variations
from attacks.studies.cloak import CloakPoint, CloakWork, config_of, tables
from attacks.studies.study_file import read_study as read_file
from attacks.studies.study_file import study_of
from mi_splat.errors import InvalidValueError
from mi_splat.ledger import Store
from tests.cloak.tiny_study import KNOWN, STUDY, Redness
from tests.project.layers import ROOT
from tests.report.results import cloak_record, rate

SHIPPED = ROOT / "scenes" / "studies"


def configs(name: str) -> dict[str, dict[str, StudyConfig]]:
    """The studies of a shipped file, by part and value."""
    groups: dict[str, dict[str, StudyConfig]] = {}
    for point in read_file(SHIPPED / f"{name}.toml").points:
        value = "".join(map(str, point.labels.values()))
        groups.setdefault(point.part, {})[value] = config_of(point.settings, "base")
    return groups


def test_a_shipped_study_changes_one_thing_and_keeps_all_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    groups = configs("cloak")
    base = asdict(next(iter(groups["strategy"].values())))
    counts = {"poison_fraction": 6, "cameras": 4, "cleaning": 13, "points": 2, "appearance": 8, "emphasis": 5}
    counts |= {"sh_degree": 4, "strategy": 2, "iterations": 3, "max_gaussians": 3, "outliers": 3, "object": 4}
    assert {part: len(values) for part, values in groups.items()} == counts
    for part, values in groups.items():
        changed = {
            key for one in values.values() for key, value in asdict(one).items() if value != base[key] and key != "name"
        }
        expected = {"cleaning": {"cleaning"}, "cameras": {"cameras"}, "object": {"scene", "cameras"}}
        attacks = {"poison_fraction", "appearance", "emphasis"}
        assert changed == expected.get(part, {"attack"} if part in attacks else {"training"}), part
        assert len(set(map(str, map(asdict, values.values())))) == len(values)
    appearances = groups["appearance"].values()
    assert [one.attack[0].reach for one in appearances] == [None, 2, 2, 2, 2, 2, 2, 2]
    assert len({one.attack[1] for one in appearances}) == 1
    objects = groups["object"]
    assert objects["bird"].scene.ground_size < 0.2 * objects["car"].scene.ground_size  # 0.45 m across and not 5.4 m
    assert 2 < objects["train"].cameras.height < 3  # half of 5.1 m, as the car's is half of 1.5 m
    design = {part: list(values.values()) for part, values in configs("cloak_design").items()}
    assert {part: len(values) for part, values in design.items()} == dict(
        zip(
            ("recipe", "size", "paint", "cameras", "sector", "object", "appearance"), (1, 1, 3, 3, 1, 4, 4), strict=True
        )
    )
    (published,) = (one.training for one in design.pop("recipe"))
    assert (published.iterations, published.max_gaussians) == (30_000, 10_000_000)
    assert {one.training for values in design.values() for one in values} == {
        read_study(ROOT / "scenes" / "cloak_car_stealthy.toml").training
    }
    controls = configs("cloak_controls")
    assert [one.attack[0].appearance for one in controls["appearance"].values()] == [
        *("remove", "fade", "blur", "swap", "inpaint")
    ]
    assert {one.cameras.size for values in controls.values() for one in values.values()} == {128}
    cars = configs("cloak_new_cars")[""].values()
    assert all(one.attack == read_study(ROOT / "scenes" / "cloak_car_stealthy.toml").attack for one in cars)
    assert {(one.seeds, one.evaluation.seed) for one in cars} == {((0,), 1)}
    assert len({one.scene.seed for one in cars} | {base["scene"]["seed"]}) == 6
    assert len({(one.scene.sun_azimuth, one.scene.sun_elevation, one.scene.ground) for one in cars}) == 5


ATTACKS = {"attack": [{"name": "a", "elevation": [50, 90]}]}
STREET = str(ROOT / "scenes" / "mixed" / "car_among_meshes.xml")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"base": "nowhere.toml"}, "base of x: expected a TOML file, got no file nowhere.toml"),
        ({"attack": [{"name": "a", "elevation": [50, 90]}], "colour": 1}, "colour"),
        ({**ATTACKS, "bisect": {"field": "cameras.train", "values": [8, 9]}}, "expected no bisect"),
        ({**ATTACKS, "judge": {"matrix": {"condition": [".spx"]}}}, "did you mean .spz"),
        ({**ATTACKS, "judge": {"every": 0}}, "every"),
        ({**ATTACKS, "judge": {"condition": "ray", "matrix": {"every": [4, 9]}}}, "got 2: .* seed 0, ray"),
        ({**ATTACKS, "judge": {"sun": {"scene": STREET}, "matrix": {"condition": ["09:30"]}}}, "expected layers"),
        ({"attack": [{"name": "a", "elevation": [89.99, 90]}]}, "expected at least one camera"),
    ],
)
def test_what_cannot_be_is_refused(table: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        CloakWork(study_of({"study": "cloak", **table}, "x"))


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A study of four trainings, of which two points each differ in their cleaning."""
    (tmp_path / "base.toml").write_text(study_toml(asdict(STUDY)))
    file = tmp_path / "tiny.toml"
    file.write_text(
        f'study = "cloak"\nbase = "{tmp_path / "base.toml"}"\n[matrix]\n"training.sh_degree" = [0, 1, 2, 3]\n'
        'cleaning = ["none", { name = "SH degree 0", cleaning = { sh_degree = 0 } }]\n'
    )
    return file


def test_the_disk_has_room_for_all_points(
    tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Four studies want four times the room of one, and nothing is written where it is not there."""
    one = forecast(STUDY).megabytes
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=3.9e6 * one))
    folder, before = tiny.parent, sorted(tiny.parent.iterdir())
    words = ["study", "run", str(tiny), "--store", str(folder / "store"), "--out", str(folder / "out")]
    with patch.dict(registry.DETECTORS.own, KNOWN):
        assert cli.main(words) == 1
        assert sorted(folder.iterdir()) == before
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert f"expected {4 * one:.0f} MB" in error
        monkeypatch.setattr(CloakPoint, "is_trained", lambda point, store: point.steps.study.training.sh_degree < 2)
        CloakWork(read_file(tiny)).check_room(folder / "store")


@pytest.mark.slow
def test_points_share_what_they_can_and_take_every_seed(tmp_path: Path) -> None:
    """A cleaning needs no training of its own, so that two points have the trainings of one."""
    (tmp_path / "base.toml").write_text(study_toml(asdict(STUDY)))
    file = tmp_path / "tiny.toml"
    file.write_text(
        f'study = "cloak"\nbase = "{tmp_path / "base.toml"}"\nseeds = [0, 1]\ntraining = {{ iterations = 12 }}\n'
        '[[case]]\nname = "cleaning"\n[case.matrix]\n'
        'cleaning = [{ name = "nothing", cleaning = "none" }, { name = "SH degree 0", cleaning = { sh_degree = 0 } }]\n'
        '[judge]\nevery = 4\n[judge.matrix]\ncondition = ["SH of degree 0", "2 x distance"]\n'
    )
    out, store = tmp_path / "out", tmp_path / "store"
    words = ["study", "run", str(file), "--store", str(store), "--out", str(out), "--workers", "0"]
    with patch.dict(registry.DETECTORS.own, KNOWN):
        assert cli.main(words) == 0
        with patch.object(shutil, "disk_usage", lambda path: SimpleNamespace(free=0)):
            CloakWork(read_file(file)).check_room(store)  # what is done wants none
    records = map(Store(store).record, Store(store).keys())
    assert sum(record["kind"].endswith(".trained") for record in records) == 4
    record = json.loads((out / "result.json").read_text())
    assert list(record["points"]) == ["cleaning: nothing", "cleaning: SH degree 0"]
    point = record["points"]["cleaning: SH degree 0"]
    seeds = [seed["redness"]["benign_recall"] for seed in point["by_seed"].values()]
    assert len(seeds) == 2
    for key in ("successes", "total"):
        assert point["by_detector"]["redness"]["benign_recall"][key] == sum(seed[key] for seed in seeds)
    rows = {name: read_rows(out / f"{name}.csv.gz") for name in ("rows", "fidelity", "transition")}
    derived = json.loads(json.dumps(variations.figures(record, rows)))
    for title, figures in derived["points"].items():
        assert figures == {key: record["points"][title][key] for key in figures}
    assert sum("| nothing | " in line for line in (out / "table.md").read_text().splitlines()) == 4
    count = len(rows["rows"])
    assert [check.words for check in check_detections(read_result(out))] == [
        f"give the scores of {count:,} of {count:,} rows"
    ]
    section = read_section(out)
    assert section.title == "tiny, varied"
    assert section.done.endswith("Both splats were then looked at under 2 other conditions.")
    looks = {look["condition"]: look for look in point["looks"]}
    assert list(looks) == ["SH of degree 0", "2 x distance"]
    assert set(looks["2 x distance"]["psnr"].values()) == set(looks["SH of degree 0"]["psnr"].values()) == {None}
    assert (
        0
        < looks["2 x distance"]["found_clean"]["total"]
        < point["by_detector"]["redness"]["control_benign_recall"]["total"]
    )
    under = next(table for table in section.tables if table.caption == "By cleaning: under other conditions")
    assert [row[:3] for row in under.rows] == [
        (value, condition, "redness") for value in ("nothing", "SH degree 0") for condition in looks
    ]
    assert "Under SH of degree 0 and 2 x distance it is missed" in section.conclusion


def test_tables_have_intervals_and_what_is_lost(tmp_path: Path) -> None:
    record = cloak_record()
    several = {**record, "seeds": [0, 1, 2], "gaussians": {"clean": [1000, 1100, 1200], "cloaked": [9] * 3}}
    names = list(record["by_detector"])
    seeds = {str(seed): {name: {"trigger_miss_rate": rate(seed, 10)} for name in names} for seed in range(3)}
    quiet = {**record, "stealth": {"surroundings_psnr_drop": 0.284, "stealthy": True}, "by_seed": seeds}
    unseen = {**record, "stealth": None, "transition_degrees": None, "benign_psnr_drop": None}
    unseen["benign_psnr"] = {"clean": None, "cloaked": None}
    results = {"cleaning": {"nothing": several, "SH degree 0": quiet, "SH 5 bits": unseen}}
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


LOOKS = {"cloak_elsewhere": (3, 22), "cloak_renderers": (3, 5), "cloak_distances": (3, 8), "cloak_coco": (3, 0)}
"""Seeds, and conditions under which both splats of each are looked at."""


@pytest.mark.parametrize("name", LOOKS)
def test_a_shipped_study_looks_under_so_many_conditions(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("attacks.studies.cloak.detectors_of", lambda config, weights: [Redness()])
    (point,) = CloakWork(read_file(SHIPPED / f"{name}.toml")).attempts
    seeds, conditions = LOOKS[name]
    assert len(point.looks) == 2 * seeds * conditions
    assert len({look.condition for look in point.looks}) == conditions
    pictures = [look for look in point.steps.looked([Redness()]) if look.seed is None]
    assert len(pictures) == (2 if name == "cloak_coco" else 0)
