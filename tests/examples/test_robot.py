"""The robot of docs/examples: it stops before what it sees, hits what it does not see, and refuses nonsense."""

import json
import runpy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.detectors.base import Candidates, Detections
from mi_splat.cameras import look_at
from mi_splat.io import save_splat
from mi_splat.io.camera_records import recorded_cameras
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc
from tests.fakes import blobs, register

pytest.importorskip("mujoco", reason="needs the extra robots")
ROBOT = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "examples" / "robot.py"))
BOX = (-1.0, -0.5, 0.0, 1.0, 0.5, 1.0)


@dataclass
class RedBox:
    """A box around all red pixels is a train."""

    name: str = "fake_red"
    classes: tuple[str, ...] = ("train",)
    fingerprint: str = "00000000c0104e5f"
    min_confidence: float = 0.05

    def candidates(self, images: Tensor) -> list[Candidates]:
        raise NotImplementedError

    def detect(self, images: Tensor) -> list[Detections]:
        detections = []
        for image in images:
            rows, columns = (image[..., 0] > image[..., 1] + 0.2).nonzero(as_tuple=True)
            seen = len(rows) > 0
            corners = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] if seen else []
            boxes = torch.tensor(corners, dtype=torch.float32).reshape(-1, 4)
            detections.append(Detections(boxes, torch.full((int(seen),), 0.9), ("train",) * int(seen)))
        return detections


def block(red: float) -> GaussianScene:
    """Gaussians all over `BOX`, within it to two standard deviations."""
    low, high = torch.tensor(BOX).reshape(2, 3) + torch.tensor([[0.16], [-0.16]])
    count = 200
    return GaussianScene(
        means=low + (high - low) * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)),
        scales=torch.full((count, 3), 0.08),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous(),
        opacities=torch.full((count,), 0.9),
        sh=colour_to_dc(torch.tensor([red, 0.2, 0.2])).expand(count, 1, 3).contiguous(),
    )


def approach(**values: Any) -> Any:
    return ROBOT["Approach"](speed=6.0, start=8.0, focal=60.0, size=48, **values)


def drive(red: float, way: Any) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    rows, pictures = ROBOT["drive"](block(red), way, RedBox(), blobs, BOX)
    assert len(pictures) == sum(row["score"] is not None for row in rows)
    return rows, ROBOT["outcome"](rows, way.confidence)


@pytest.mark.parametrize("elevation", [0.0, 60.0])
def test_it_stops_before_what_it_sees(elevation: float) -> None:
    rows, end = drive(0.9, approach(elevation=elevation))
    assert end["stopped"]
    assert 0.1 < end["margin"] < 4
    begun = next(row for row in rows if row["braking"])
    assert begun["speed"] == pytest.approx(6, abs=0.01)
    # v^2 / 2a, as elementary mechanics has it.
    assert begun["distance"] - end["margin"] == pytest.approx(6**2 / (2 * 6), abs=0.35)


def test_it_hits_what_it_does_not_see_at_full_speed() -> None:
    rows, end = drive(0.2, approach())
    assert (end["stopped"], end["margin"], end["first_seen"]) == (False, None, None)
    assert end["hit_at"] == pytest.approx(6, abs=0.01)
    assert rows[-1]["time"] == pytest.approx(8 / 6, abs=0.05)


def test_its_camera_is_where_mujoco_has_it() -> None:
    robot = ROBOT["Robot"](approach(azimuth=30.0, elevation=40.0), BOX)
    assert robot.distance == pytest.approx(8, abs=0.5)  # along the path; this is the shortest way
    for _ in range(3):
        robot.move(6.0)
        camera = robot.camera
        torch.testing.assert_close(camera.to_world, look_at(camera.position.tolist(), robot.middle), atol=1e-6, rtol=0)
    gone = robot.start - float((camera.position - torch.from_numpy(robot.middle)).norm())
    assert gone == pytest.approx(3 * 0.6, abs=0.01)


def test_the_command_writes_rows_a_figure_and_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib", reason="figures need the extra report")
    register(monkeypatch, {"fake_red": RedBox()})
    save_splat(block(0.9), tmp_path / "red.ply")
    words = ["--detectors", "fake_red", "--size", "32", "--focal", "40", "--start", "3", "--out", str(tmp_path / "out")]
    words += ["--box", *map(str, BOX)]
    assert ROBOT["main"]([f"red={tmp_path}/red.ply", *words, "--speeds", "2", "4"]) == 0
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert [one["stopped"] for one in document["drives"]] == [True, True]
    assert len(recorded_cameras(tmp_path / "out" / "result.json") or {}) == ROBOT["VIEWS"]
    assert len(list((tmp_path / "out").glob("*.png"))) == 3


@pytest.mark.parametrize(
    "words", [["red.ply"], ["a=gone.ply"], ["a=red.ply", "--detectors", "nobody"], ["a=red.ply", "--speeds", "0"]]
)
def test_bad_words_leave_nothing(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    save_splat(block(0.9), tmp_path / "red.ply")
    assert ROBOT["main"](words) == 1
    assert "expected" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["red.ply"]
