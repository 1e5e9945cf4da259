"""From where detectors find a study's object: who looks, what is kept, what is counted, and what is written."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from PIL import Image
from torch import Tensor

from attacks import cli
from attacks.cloak.config import AttackConfig, CameraConfig, EvaluationConfig, StudyConfig
from attacks.cloak.detection_curve import (
    ELSEWHERE,
    FILES,
    check_results,
    chosen,
    detection_rates,
    spread,
    tables,
    watch,
    with_scores,
    write_detection_curve,
)
from attacks.cloak.kinds import seen
from attacks.cloak.steps import StudySteps, TrainedSplat
from attacks.cloak.study import begin_report
from attacks.detectors.base import Detections
from attacks.observe.rows import ATTACKED, CLEAN, TRUE, frame_of
from attacks.rate import Rate
from mi_splat.errors import InvalidValueError
from mi_splat.ledger import Job
from tests.cloak.made_splat import Made
from tests.cloak.tiny_study import Redness, steps_of

STUDY = StudyConfig(
    name="small",
    seeds=(0, 1),
    cameras=CameraConfig(train=40, size=40, distance=7.4, samples=1, points=100),
    attack=(
        AttackConfig(name="overhead", elevation=(38.2, 90)),
        AttackConfig(
            name="rear",
            appearance="paint",
            texture="stop_sign",
            elevation=(0, 38.1),
            azimuth=(180, 30),
            target_class="stop sign",
        ),
    ),
    evaluation=EvaluationConfig(detectors=("redness",), cameras=48),
)
EVERY = 6


def series(splat: str, seed: int | None, *confidences: float, target: float = 0.0) -> list[dict[str, Any]]:
    """One camera at 5 degrees, one at 45, one from behind and one at 85, with these confidences."""
    places = [(10.0, 5.0), (10.0, 45.0), (180.0, 5.0), (300.0, 85.0)]
    return [
        {
            **{"splat": splat, "seed": seed, "detector": "d", "view": view, "azimuth": azimuth, "elevation": elevation},
            "depth: overhead": elevation - 38.2,
            "depth: rear": 1.0 if abs(azimuth - 180) <= 30 and elevation <= 38.1 else -1.0,
            **{"own": own, "target": target},
        }
        for view, ((azimuth, elevation), own) in enumerate(zip(places, confidences, strict=True))
    ]


FOUND = pl.DataFrame(
    [
        *series(TRUE, None, 0.9, 0.4, 0.9, 0.1),
        *series(CLEAN, 0, 0.9, 0.4, 0.9, 0.1),
        *series(CLEAN, 1, 0.4, 0.2, 0.9, 0.1),
        *series(ATTACKED, 0, 0.9, 0.0, 0.0, 0.0, target=0.8),
        *series(ATTACKED, 1, 0.9, 0.0, 0.0, 0.0),
    ],
    infer_schema_length=None,
)


def counts(kind: str, splat: str, **settings: object) -> dict[str, str]:
    found = chosen(detection_rates(STUDY, FOUND), kind, detector="d", splat=splat, **settings)  # type: ignore[arg-type]
    return {group.name: f"{rate.successes}/{rate.total}" for group, rate in found}


def test_rates_are_of_all_seeds_together_and_leave_the_rear_out() -> None:
    assert counts("elevation", TRUE) == {"0 to 10": "1/1", "40 to 50": "0/1", "80 to 90": "0/1"}
    assert counts("elevation", CLEAN) == {"0 to 10": "1/2", "40 to 50": "0/2", "80 to 90": "0/2"}
    assert counts("elevation", CLEAN, confidence=0.3) == {"0 to 10": "2/2", "40 to 50": "1/2", "80 to 90": "0/2"}
    assert counts("azimuth", ATTACKED) == {"0 to 30": "2/2", "180 to 210": "0/2"}
    assert counts("region", ATTACKED) == {"overhead": "0/4", "rear": "0/2", ELSEWHERE: "2/2"}
    assert counts("region", ATTACKED, reported="target")["rear"] == "1/2"


def test_every_seed_has_its_rates() -> None:
    rows = detection_rates(STUDY, FOUND)
    row = next(row for row in rows if (row.group.name, row.splat, row.confidence) == (ELSEWHERE, CLEAN, 0.5))
    assert row.seed is None
    assert [rate.fraction for rate in spread(rows, row)] == [1.0, 0.0]
    assert {one.seed for one in rows if one.splat == TRUE} == {None}
    table = tables(rows, {"d": "0" * 16})
    assert "| 0 to 10 | 1/1, 1/2, 2/2 |" in table
    assert f"{Rate(successes=1, total=2).words}; 0% to 100%" in table


class Watcher(Redness):
    """Counts the pictures that it looks at."""

    def __init__(self, fingerprint: str = "1" * 16) -> None:
        self.fingerprint, self.pictures = fingerprint, 0

    def detect(self, images: Tensor) -> list[Detections]:
        self.pictures += len(images)
        return super().detect(images)


@pytest.fixture
def splats(monkeypatch: pytest.MonkeyPatch) -> list[TrainedSplat]:
    """Those of a study, which it has not trained."""
    jobs = {
        (splat, seed): Job(kind="tests.cloak.made_splat", config=Made(number=2 * seed + (splat == "cloaked")))
        for seed in STUDY.seeds
        for splat in ("clean", "cloaked")
    }
    monkeypatch.setattr(StudySteps, "splat", lambda self, splat, seed: jobs[splat, seed])
    return []


def look(
    folder: Path, detectors: Sequence[Watcher], monkeypatch: pytest.MonkeyPatch
) -> tuple[StudySteps, list[TrainedSplat], pl.DataFrame]:
    by_name = {detector.name: detector for detector in detectors}
    monkeypatch.setattr(seen, "loaded", lambda name, weights=None: by_name[name])
    steps = steps_of(folder, STUDY)
    splats = [
        TrainedSplat(splat=splat, seed=seed, done=steps.do(steps.splat(splat, seed), ""))
        for seed in STUDY.seeds
        for splat in ("clean", "cloaked")
    ]
    return steps, splats, watch(steps, splats, detectors, every=EVERY)


@pytest.mark.usefixtures("splats")
def test_who_has_looked_does_not_look_again(variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Watcher()
    steps, _, found = look(tmp_path / "stages", [first], monkeypatch)
    cameras = found["view"].n_unique()
    assert cameras > 3
    assert first.pictures == 5 * cameras
    order = found.select("splat", "seed").unique(maintain_order=True).rows()
    assert order == [(TRUE, None), *[(splat, seed) for seed in STUDY.seeds for splat in (CLEAN, ATTACKED)]]
    assert max(found.filter(splat=TRUE)["own"]) > 0  # the true car is red
    same, retrained = Watcher(), Watcher("2" * 16)
    retrained.name = "retrained"
    steps, splats, again = look(tmp_path / "stages", [same, retrained], monkeypatch)
    assert same.pictures == 0
    assert retrained.pictures == first.pictures
    assert again.filter(detector="redness").equals(found)

    pytest.importorskip("matplotlib", reason="plots need the extra figures")
    out = tmp_path / "out"
    out.mkdir()
    document = write_detection_curve(steps, again, splats, [same, retrained], out, every=EVERY)
    assert {path.name for path in out.iterdir()} == set(FILES)
    assert json.loads((out / FILES[0]).read_text()) == document
    assert document["detectors"] == {"redness": "1" * 16, "retrained": "2" * 16}
    assert all(row["total"] for row in document["rates"])
    with Image.open(out / "contact.png") as sheet:
        assert sheet.height * 7 == sheet.width * 6  # square cells: two detectors, three kinds of pictures


def test_what_is_no_finished_study_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="run `mi-splat cloak` first"):
        check_results(STUDY, tmp_path)
    begin_report(STUDY, tmp_path)
    (tmp_path / "result.json").write_text("{}")
    check_results(STUDY, tmp_path)
    with pytest.raises(InvalidValueError, match="pass its own results"):
        check_results(replace(STUDY, seeds=(0,)), tmp_path)
    steps = steps_of(tmp_path / "stages", STUDY)
    with pytest.raises(InvalidValueError, match="every: expected a positive number"):
        watch(steps, [], [], every=0)
    with pytest.raises(InvalidValueError, match="no clean splat of seed 0") as error:
        steps.finished_splats()
    assert error.value.hint == "--stages"


def test_any_vehicle_counts_for_a_car_on_the_object_alone() -> None:
    rows = frame_of([{"splat": CLEAN, "seed": 0, "detector": "d", "view": view} for view in (0, 1)])
    cells = [("truck", 0.6, 0.7), ("car", 0.5, 0.9), ("bus", 0.9, 0.4), ("stop sign", 0.8, 0.5), ("bird", 0.95, 1.0)]
    ids: dict[str, Any] = {"splat": CLEAN, "seed": 0, "detector": "d", "view": 0}
    detections = frame_of([{**ids, "label": label, "score": score, "iou": iou} for label, score, iou in cells])
    found = with_scores(STUDY, rows, detections)
    assert found["own"].to_list() == [0.6, 0.0]
    assert found["target"].to_list() == [0.8, 0.0]


def test_the_command_says_what_it_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "small.toml"
    path.write_text("name = 'small'\n[cameras]\ntrain = 60\n[[attack]]\nname = 'a'\nelevation = [50, 90]\n")
    words = ["cloak-experiment", "detection-curve", str(path)]
    for more, said in (
        ([], "--results"),
        (["--results", str(tmp_path)], "--out: expected a folder"),
        (["--results", str(tmp_path), "--out", str(tmp_path)], "expected a new or an empty folder"),
        (["--results", str(tmp_path), "--out", str(tmp_path / "new")], "run `mi-splat cloak` first"),
    ):
        assert cli.main([*words, *more]) == 1
        assert said in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
