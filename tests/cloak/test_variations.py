"""A study with one thing changed at a time: the studies of each group, and the tables and plots of what they find."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from attacks import cli
from attacks.cloak import variations
from attacks.cloak.config import StudyConfig
from attacks.cloak.variations import CLEANINGS, check_variations, tables, varied, vary, write_variation
from mi_splat.errors import InvalidValueError
from mi_splat.fields import decode
from tests.cloak.tiny_study import STUDY, Redness
from tests.report.results import STUDIED, cloak_summary, rate

SEEDS = replace(STUDY, seeds=(0, 1, 2))


@pytest.mark.slow
def test_variations_share_what_they_can_and_take_every_seed(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One value, for each costs a training of every seed."""
    monkeypatch.setattr(variations, "varied", lambda study, group: {"classic": varied(study, group)["classic"]})
    study = replace(STUDY, seeds=(0, 1), training=replace(STUDY.training, iterations=12))
    said: list[str] = []
    found = vary(
        study,
        ["strategy"],
        tmp_path,
        stages=finished / "stages",
        on_step=lambda text, done, total: said.append(text),
    )
    assert list(found["strategy"]) == ["classic"]
    assert not [text for text in said if "pictures" in text or text == "poisoning"]
    one = found["strategy"]["classic"]
    seeds = [seed["redness"]["benign_recall"] for seed in one["by_seed"].values()]
    assert len(seeds) == 2
    for key in ("successes", "total"):
        assert one["by_detector"]["redness"]["benign_recall"][key] == sum(seed[key] for seed in seeds)
    with Image.open(tmp_path / "strategy.png") as plot:
        assert plot.size[0] > 500
    table = (tmp_path / "variations.md").read_text().splitlines()
    assert len(table) == 2 + 1 + 1 + 2 + 1
    assert table[2].startswith("| classic | redness | ")
    assert table[6].startswith("| classic | 2 | ")


@pytest.mark.parametrize(
    ("groups", "values", "match"),
    [
        (["poison_fraction"], ["90"], r"values: expected one of 5%, 25%, .* got 90; did you mean 90%"),
        (["poison_fraction", "strategy"], ["90%"], r"values: expected some of strategy \(classic or mcmc\), got 90%"),
    ],
)
def test_values_that_cannot_be_are_refused(groups: Any, values: list[str], match: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match=match):
        check_variations(SEEDS, groups, [Redness()], tmp_path, tmp_path / "stages", values=values)


def test_values_need_a_group(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["cloak", "scenes/cloak_demo.toml", "--values", "90%", "--out", str(tmp_path / "out")]) == 1
    assert "--values: expected values of a group, got 90% alone; add --vary" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_some_values_are_done_and_join_those_done_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    places: list[str] = []

    def done(study: StudyConfig, place: Path, **_: object) -> dict[str, Any]:
        places.append(place.name)
        return {"iterations": study.training.iterations}

    monkeypatch.setattr(variations, "run_study", done)
    monkeypatch.setattr(variations, "tables", lambda found: "")
    monkeypatch.setattr(variations, "write_variation", lambda *_: None)
    assert list(vary(SEEDS, ["iterations"], tmp_path, values=["160"])["iterations"]) == ["160"]
    found = vary(SEEDS, ["iterations"], tmp_path, values=["26"])
    assert found == {"iterations": {"26": {"iterations": 26}, "160": {"iterations": 160}}}
    assert places == ["2", "0"]


def test_variations_change_one_thing_and_keep_all_seeds() -> None:
    fractions = varied(SEEDS, "poison_fraction")
    assert [study.attack[0].poison_fraction for study in fractions.values()] == [0.05, 0.25, 0.5, 0.75, 0.9, 1.0]
    observed = varied(SEEDS, "appearance")
    assert [study.attack[0].texture for study in observed.values()] == [
        "road",
        None,
        None,
        None,
        "road",
        "grass",
        "clock",
        "football",
    ]
    assert all(study.attack[1] == STUDY.attack[1] for study in observed.values())
    assert [study.training.sh_degree for study in varied(SEEDS, "sh_degree").values()] == [0, 1, 2, 3]
    assert [study.attack[1].emphasis for study in varied(SEEDS, "emphasis").values()] == [1.0, 1.5, 2.2, 3.0, 4.5]
    assert [study.training.outliers for study in varied(SEEDS, "outliers").values()] == [0, 1000, 4000]
    most = varied(SEEDS, "max_gaussians")
    assert {name: study.training.max_gaussians for name, study in most.items()} == {
        **{"40,000": 40_000, "80,000": 80_000, "160,000": 160_000}
    }
    assert [study.training.point_deviations for study in varied(SEEDS, "points").values()] == [None, 2.0]
    assert [study.training.iterations for study in varied(SEEDS, "iterations").values()] == [26, 80, 160]
    objects = varied(SEEDS, "object")
    assert list(objects) == ["car", "elephant", "bird", "train"]
    assert objects["car"] == SEEDS
    assert objects["bird"].scene.ground_size < 0.2 * SEEDS.scene.ground_size  # 0.45 m across and not 5.4 m
    assert 2 < objects["train"].cameras.height < 3  # half of 5.1 m, as the car's is half of 1.5 m
    cameras = varied(SEEDS, "cameras")
    assert {name: study.cameras.train for name, study in cameras.items()} == {
        **{"60": 60, "120": 120},
        **{"210": 210, "420": 420},
    }
    cleaning = varied(SEEDS, "cleaning")
    assert {name: study.cleaning for name, study in cleaning.items()} == CLEANINGS
    for studies in (fractions, observed, cameras, cleaning):
        assert {study.seeds for study in studies.values()} == {(0, 1, 2)}
    assert {replace(study, cleaning=None) for study in cleaning.values()} == {SEEDS}


def test_an_occluder_has_no_reach() -> None:
    """It is drawn over the picture, so that a study of a reach needs another one to be varied."""
    overhead, rear = STUDY.attack
    study = replace(STUDY, attack=(replace(overhead, appearance="remove", reach=2), rear))
    found = varied(study, "appearance")
    assert found["occluder"].attack[0].reach is None
    assert {one.attack[0].reach for name, one in found.items() if name != "occluder"} == {2}


def test_tables_have_intervals_and_what_is_lost(tmp_path: Path) -> None:
    several = {**cloak_summary(), "seeds": [0, 1, 2], "gaussians": {"clean": [1000, 1100, 1200], "cloaked": [9] * 3}}
    names = STUDIED.evaluation.detectors
    seeds = {str(seed): {name: {"trigger_miss_rate": rate(seed, 10)} for name in names} for seed in range(3)}
    quiet = {**cloak_summary(), "stealth": {"surroundings_psnr_drop": 0.284, "stealthy": True}, "by_seed": seeds}
    unseen = {**cloak_summary(), "stealth": None, "transition_degrees": None, "benign_psnr_drop": None}
    unseen["benign_psnr"] = {"clean": None, "cloaked": None}
    found = {"cleaning": {"nothing": several, "SH degree 0": quiet, "SH 5 bits": unseen}}
    rates, costs = ([line.split(" | ") for line in text.splitlines()] for text in tables(found).split("\n\n"))
    assert len(rates) == 2 + 3 * len(names)
    assert {len(row) for row in rates if len(row) > 1} == {7}
    assert "nothing of any class reported" in rates[0]
    assert rates[2][3].startswith("18/20 = 90.0% (69.9% to 97.2%)")
    assert rates[2 + len(names)][3].endswith("; by seed 0.0% to 20.0%")
    assert [" | ".join(row) for row in costs[2:]] == [
        "| nothing | 3 | 9.7 | 34.00 | 1.00 | 4.40 | no | 1,100 | 9 |",
        "| SH degree 0 | 2 | 9.7 | 34.00 | 1.00 | 0.28 | yes | 1,000 | 1,200 |",
        "| SH 5 bits | 2 | - | - | - | - | - | 1,000 | 1,200 |",
    ]
    write_variation("cleaning", {f"value {i}": quiet for i in range(8)}, tmp_path / "plot.png")
    with Image.open(tmp_path / "plot.png") as plot:
        assert plot.size[0] > 500


def test_a_study_says_in_its_file_how_splats_are_cleaned() -> None:
    table = {"name": "x", "attack": [{"name": "a", "elevation": [50, 90]}], "cleaning": {"sh_degree": 1}}
    assert decode(type(STUDY), table, "x").cleaning == CLEANINGS["SH degree 1"]
