"""What is seen of a study's splats under other conditions, and of path-traced images
in the place of a splat.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import Mock

import polars as pl
import pytest
import torch
from torch import Tensor

from attacks.cloak.config import LayersConfig, StudyConfig
from attacks.cloak.figures import figures, pooled_psnr
from attacks.cloak.kinds import seen
from attacks.cloak.setup import Setup
from attacks.cloak.steps import StudySteps
from attacks.cloak.transition import Tables
from attacks.observe import conditions
from attacks.observe.conditions import SunTable
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    DETECTIONS,
    ROWS,
    SUFFIX,
    frame_of,
    read_rows,
)
from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.ledger import Out
from mi_splat.render.scene_files import SplatScene
from mi_splat.scene import GaussianScene, merge
from tests.cloak.test_study_rates import study_rows
from tests.cloak.tiny_study import STUDY, Redness

pytestmark = pytest.mark.shipped

STREET = SunTable(
    scene="scenes/mixed/car_among_meshes.xml", parameter="car", north=4.0, samples=1
)
LAYERED = replace(STUDY, layers=LayersConfig(attacks=("overhead",)))


def gaussian(opacity: float = 0.5, degree: int = 0, **values: Tensor) -> GaussianScene:
    """One in the middle of the car."""
    means = torch.tensor([[0.0, 0.0, 0.7]])
    turn = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    sh = torch.zeros(1, (degree + 1) ** 2, 3)
    return GaussianScene(
        means, torch.ones(1, 3), turn, torch.tensor([opacity]), sh
    ).replace(**values)


def looked(
    folder: Path, splat: GaussianScene, study: StudyConfig = STUDY, **how: Any
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """The rows and the detections of a look, by the job's own code."""
    folder.mkdir()
    save_splat(splat, folder / "splat.ply")
    steps = StudySteps(study=study)
    config = steps.seen(Mock(kind="made"), Redness(), **how).config
    seen.run(
        config,
        {"splat": folder / "splat.ply", **steps.object_input},
        Out(files=folder, kept=folder, progress=lambda *told: None),
    )
    rows, detections = (
        read_rows(folder / f"{name}{SUFFIX}") for name in (ROWS, DETECTIONS)
    )
    return rows, detections


def test_cameras_come_nearer_and_are_the_same_views(tmp_path: Path) -> None:
    plain, _ = looked(tmp_path / "plain", gaussian())
    near, detections = looked(
        tmp_path / "near", gaussian(), condition="0.5 x distance", every=5
    )
    assert "condition" not in plain.columns
    assert near["condition"].unique().to_list() == ["0.5 x distance"]
    assert near["view"].to_list() == plain["view"].to_list()[::5]
    same = plain.filter(pl.col("view").is_in(near["view"].to_list()))
    for column in ("azimuth", "elevation", "depth: overhead", "depth: rear"):
        assert near[column].to_list() == pytest.approx(same[column].to_list(), abs=1e-4)
    assert near["distance"].to_list() == pytest.approx(
        [one / 2 for one in same["distance"]]
    )
    assert set(detections["view"]) == set(near["view"])


def test_forms_of_a_file_say_which_of_them_keeps_large_coefficients(
    tmp_path: Path,
) -> None:
    sh = torch.zeros(1, 16, 3)
    sh[0, 15] = 50.0
    kept = {}
    for name in (
        ".ply",
        ".glb",
        "SH in float16",
        ".spz",
        ".splat",
        "SH of degree 2",
        "tile",
        "tile-colours-in-0-1",
    ):
        rows, _ = looked(tmp_path / name, gaussian(0.9, sh=sh), condition=name, every=4)
        kept[name] = pooled_psnr(rows["psnr"])
    assert [name for name, psnr in kept.items() if psnr is None] == [
        ".ply",
        ".glb",
        "SH in float16",
        "tile",
    ]


def test_what_two_detectors_report_is_counted_under_each_condition() -> None:
    def row(
        condition: str | None,
        view: int,
        depth: float,
        splat: str,
        score: float,
        psnr: float | None,
    ) -> Any:
        ids = {
            "condition": condition,
            "splat": splat,
            "seed": 0,
            "detector": "redness",
            "view": view,
        }
        angles = {
            "azimuth": 10.0 * view,
            "elevation": 40.0,
            "depth: overhead": depth,
            "depth: rear": -10.0,
        }
        sign = {"target_score: rear": 0.0, "any_overlap": score, "score": score}
        return {**ids, **angles, "original_score": score, **sign, "psnr": psnr}

    rows = frame_of(
        row(condition, view, depth, splat, score, psnr)
        for condition, cloaked, psnr in (
            (None, 0.0, None),
            (".spz", 0.9, 20.0),
            ("ray", 0.1, None),
        )
        for view, depth, inside in ((0, 10.0, True), (1, 2.0, True), (2, -3.0, False))
        for splat, score in ((CLEAN, 0.9), (ATTACKED, cloaked if inside else 0.8))
    )
    counted = figures(STUDY, tables_of(rows), [])
    spz, ray = (
        counted.where(condition=name, detector="redness") for name in (".spz", "ray")
    )
    splats = (CLEAN, ATTACKED)
    assert [spz.rate("missed", splat=splat).counts for splat in splats] == [
        "0 of 1"
    ] * 2
    assert [spz.rate("found", splat=splat).counts for splat in splats] == ["1 of 1"] * 2
    assert [ray.rate("missed", splat=splat).successes for splat in splats] == [0, 1]
    assert [ray.rate("found", splat=splat).successes for splat in splats] == [1, 1]
    assert spz.rate("target_rate").total == 0
    for measure in ("psnr_missed", "psnr_found"):
        for splat in splats:
            assert spz.value(measure, splat=splat) == pytest.approx(20.0)
            assert ray.value(measure, splat=splat) is None
    # of the splats as the victim sees them alone
    assert counted.rate("control_recall").total == 2


def tables_of(rows: pl.DataFrame) -> Tables:
    return {**study_rows(), ROWS: rows}


class Street:
    """A street that is red in the morning and grey later, and remembers what was put
    into it, and who looked.
    """

    made: ClassVar[list[dict[str, Any]]] = []
    cameras: ClassVar[list[Camera]] = []

    def __init__(self, path: Path, *, samples: int, car: str, **sun: float) -> None:
        self._red, scene = sun["sun_x"] > 0.1, load_splat(Path(car))
        self.splats = SplatScene(scene=scene, objects={}, cameras={}, settings=None)  # type: ignore[arg-type]
        self.made.append({"scene": scene, "samples": samples, **sun})

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        self.cameras.append(camera)
        return torch.tensor([1.0, 0.0, 0.0] if self._red else [0.5, 0.5, 0.5]).expand(
            40, 40, 3
        )


def test_the_object_alone_stands_on_the_street_by_the_hour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody looks out of a house, and the light is not compared with that of the
    splat.
    """
    monkeypatch.setattr(conditions, "MixedScene", Street)
    far = gaussian(0.1, means=torch.tensor([[30.0, 0.0, 0.0]]))
    for hour in ("08:00", "12:00", "16:00"):
        rows, _ = looked(
            tmp_path / hour,
            merge(gaussian(0.9), far),
            LAYERED,
            condition=hour,
            sun=STREET,
        )
        assert "psnr" not in rows.columns
        assert (rows["original_score"] > 0.5).any() == (hour == "08:00")
        assert 4 < len(rows) < len(Setup.of(STUDY).held_out_cameras)
    assert [len(one["scene"]) for one in Street.made] == [1, 1, 1]
    assert torch.equal(Street.made[0]["scene"].means, gaussian().means)
    assert [one["sun_z"] for one in Street.made] == pytest.approx(
        [0.353553, 0.707107, 0.353553], abs=1e-5
    )
    assert Street.made[0]["sun_x"] == pytest.approx(-Street.made[2]["sun_x"])
    assert all(float(camera.position[1]) < 4.0 for camera in Street.cameras)
    with pytest.raises(InvalidValueError, match="cameras south of it, got none"):
        looked(
            tmp_path / "north",
            gaussian(0.9),
            LAYERED,
            condition="08:00",
            sun=replace(STREET, north=-99.0),
        )
