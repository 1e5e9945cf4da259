"""From where detectors find a study's object: who looks, what is kept, what is counted, and what is written."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from torch import Tensor

from attacks import cli
from attacks.cloak.config import AttackConfig, CameraConfig, EvaluationConfig, StudyConfig
from attacks.cloak.experiments.detection_rates import ELSEWHERE, chosen, detection_rates, spread
from attacks.cloak.experiments.detection_report import FILES, tables, write_detection_curve
from attacks.cloak.experiments.view_reports import ViewReport, ViewReports, finished_splats, watch
from attacks.cloak.plots import TRUE
from attacks.cloak.study.cache import content_of
from attacks.cloak.study.pipeline import StudyPipeline
from attacks.cloak.study.run import begin_report
from attacks.cloak.study.trained_splats import TrainedSplat
from attacks.detectors.base import Detections
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from tests.cloak.tiny_study import Redness
from tests.fakes import toy_scene

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


def seen(view: int, azimuth: float, elevation: float, own: float, target: float = 0.0) -> ViewReport:
    """A view_report from a direction of `STUDY`, with the signs of its depths."""
    rear = abs(azimuth - 180) <= 30 and elevation <= 38.1
    return ViewReport(
        view=view,
        azimuth=azimuth,
        elevation=elevation,
        depths={"overhead": elevation - 38.2, "rear": 1.0 if rear else -1.0},
        own=own,
        target=target,
        own_near=max(own, 0.6),
        target_near=target,
    )


def series(pictures: str, seed: int | None, *confidences: float, target: float = 0.0) -> ViewReports:
    """One camera at 5 degrees, one at 45, one from behind and one at 85, with these confidences."""
    places = [(10.0, 5.0), (10.0, 45.0), (180.0, 5.0), (300.0, 85.0)]
    view_reports = [
        seen(i, *place, value, target) for i, (place, value) in enumerate(zip(places, confidences, strict=True))
    ]
    return ViewReports(pictures=pictures, seed=seed, detector="d", view_reports=tuple(view_reports))


FOUND = [
    series(TRUE, None, 0.9, 0.4, 0.9, 0.1),
    series("clean", 0, 0.9, 0.4, 0.9, 0.1),
    series("clean", 1, 0.4, 0.2, 0.9, 0.1),
    series("cloaked", 0, 0.9, 0.0, 0.0, 0.0, target=0.8),
    series("cloaked", 1, 0.9, 0.0, 0.0, 0.0),
]


def counts(kind: str, pictures: str, **settings: object) -> dict[str, str]:
    found = chosen(detection_rates(STUDY, FOUND), kind, detector="d", pictures=pictures, **settings)  # type: ignore[arg-type]
    return {group.name: f"{rate.successes}/{rate.total}" for group, rate in found}


def test_rates_are_of_all_seeds_together_and_leave_the_rear_out() -> None:
    assert counts("elevation", TRUE) == {"0 to 10": "1/1", "40 to 50": "0/1", "80 to 90": "0/1"}
    assert counts("elevation", "clean") == {"0 to 10": "1/2", "40 to 50": "0/2", "80 to 90": "0/2"}
    assert counts("elevation", "clean", confidence=0.3) == {"0 to 10": "2/2", "40 to 50": "1/2", "80 to 90": "0/2"}
    assert counts("azimuth", "cloaked") == {"0 to 30": "2/2", "180 to 210": "0/2"}
    assert counts("region", "cloaked") == {"overhead": "0/4", "rear": "0/2", ELSEWHERE: "2/2"}
    assert counts("region", "cloaked", reported="target")["rear"] == "1/2"


def test_every_seed_has_its_rates() -> None:
    rows = detection_rates(STUDY, FOUND)
    row = next(row for row in rows if (row.group.name, row.pictures, row.confidence) == (ELSEWHERE, "clean", 0.5))
    assert row.seed is None
    assert [rate.fraction for rate in spread(rows, row)] == [1.0, 0.0]
    assert {one.seed for one in rows if one.pictures == TRUE} == {None}
    table = tables(rows, {"d": "0" * 16})
    assert "| 0 to 10 | 1/1, 1/2, 2/2 |" in table
    assert "1/2 = 50.0% (9.5% to 90.5%); 0% to 100%" in table


class Watcher(Redness):
    """Counts the pictures that it looks at."""

    def __init__(self, fingerprint: str = "1" * 16) -> None:
        self.fingerprint, self.pictures = fingerprint, 0

    def detect(self, images: Tensor) -> list[Detections]:
        self.pictures += len(images)
        return super().detect(images)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """What a study leaves: its record, its summary, and the splats among its stages."""
    folder = tmp_path / "results"
    begin_report(STUDY, folder)
    listed = []
    for number, (which, seed) in enumerate((which, seed) for seed in STUDY.seeds for which in ("clean", "cloaked")):
        stage = folder / "stages" / f"splat-{number}"
        stage.mkdir(parents=True)
        save_splat(toy_scene(seed=number)[0], stage / "splat.ply")
        content = content_of(stage, ("splat.ply",))
        listed.append({"splat": which, "seed": seed, "content": content, "gaussians": 40, "hash": "0", "commit": None})
    (folder / "summary.json").write_text(json.dumps({"splats": listed}))
    return folder


def look(results: Path, detectors: Sequence[Watcher]) -> tuple[StudyPipeline, list[TrainedSplat], list[ViewReports]]:
    pipeline = StudyPipeline(study=STUDY, folder=results / "stages")
    splats = finished_splats(STUDY, results, results / "stages")
    return pipeline, splats, watch(pipeline, splats, detectors, every=EVERY)


def test_who_has_looked_does_not_look_again(variant: str, results: Path, tmp_path: Path) -> None:
    first = Watcher()
    pipeline, splats, found = look(results, [first])
    cameras = len(found[0].view_reports)
    assert cameras > 3
    assert first.pictures == 5 * cameras
    assert [(one.pictures, one.seed) for one in found] == [
        (TRUE, None),
        *[(which, seed) for seed in STUDY.seeds for which in ("clean", "cloaked")],
    ]
    assert max(one.own for one in found[0].view_reports) > 0  # the true car is red
    same, retrained = Watcher(), Watcher("2" * 16)
    retrained.name = "retrained"
    _, _, again = look(results, [same, retrained])
    assert same.pictures == 0
    assert retrained.pictures == first.pictures
    assert again[::2] == found

    pytest.importorskip("matplotlib", reason="plots need the extra figures")
    out = tmp_path / "out"
    out.mkdir()
    document = write_detection_curve(pipeline, again, splats, [same, retrained], out, every=EVERY)
    assert {path.name for path in out.iterdir()} == set(FILES)
    assert json.loads((out / FILES[0]).read_text()) == document
    assert document["detectors"] == {"redness": "1" * 16, "retrained": "2" * 16}
    assert all(row["total"] for row in document["rates"])
    with Image.open(out / "contact.png") as sheet:
        assert sheet.height * 7 == sheet.width * 6  # square cells: two detectors, three kinds of pictures


def test_what_is_no_finished_study_is_refused(results: Path, tmp_path: Path) -> None:
    stages = results / "stages"
    with pytest.raises(InvalidValueError, match="run `mi-splat cloak` first"):
        finished_splats(STUDY, tmp_path, stages)
    with pytest.raises(InvalidValueError, match="pass its own results"):
        finished_splats(replace(STUDY, seeds=(0,)), results, stages)
    with pytest.raises(InvalidValueError, match="every: expected a positive number"):
        watch(StudyPipeline(study=STUDY, folder=stages), [], [], every=0)
    save_splat(toy_scene(seed=9)[0], stages / "splat-3" / "splat.ply")
    with pytest.raises(InvalidValueError, match="none of the cloaked splat of seed 1"):
        finished_splats(STUDY, results, stages)


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
