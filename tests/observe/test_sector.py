"""An object that is hidden from a sector: rates inside of it and elsewhere, of training
and held-out cameras, where the clean object is detected.
"""

from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import patch

import numpy as np
import polars as pl
import pytest
import torch

from attacks import cli
from attacks.cloak.triggers import trigger_of
from attacks.figures.rate import Rate
from attacks.observe.comparison import compared_rows, figures
from attacks.observe.rows import ROWS, rows
from attacks.observe.sector import HIDDEN, sector_cells, sector_doubts, sector_figures
from attacks.observe.views import ViewDetections, detect_scenes
from mi_splat.cameras.camera import Camera, View
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.io import save_splat
from mi_splat.maths.rotation import from_z
from tests.datasets.sets import write_transforms
from tests.fakes import ColourDetector, blobs, toy_scene

LENS = Lens(focal=40.0, size=(32, 32))


def row(
    view: int, splat: str, score: float, depth: float, split: str
) -> dict[str, object]:
    return {
        "splat": splat,
        "detector": "d",
        "view": view,
        "azimuth": 30.0 * view,
        "elevation": 10.0,
        "split": split,
        HIDDEN: depth,
        "x0": 1.0,
        "original": "car",
        "score": score,
        "original_score": score,
    }


def table() -> pl.DataFrame:
    """Of each view: depth, split, and the score of the clean and the attacked car."""
    seen = [
        (20.0, "train", 0.9, 0.1),
        (10.0, "test", 0.9, 0.1),
        (5.0, "test", 0.9, 0.8),
        (5.0, "test", 0.2, 0.1),  # the clean one is not detected either
        (-5.0, "train", 0.9, 0.9),
        (-50.0, "test", 0.9, 0.9),
        (-60.0, "test", 0.9, 0.3),
    ]
    lines = []
    for view, (depth, split, clean, attacked) in enumerate(seen):
        lines.append(row(view, "clean", clean, depth, split))
        lines.append(row(view, "attacked", attacked, depth, split))
    return pl.DataFrame(lines)


def counts(rate: Rate) -> tuple[int, int]:
    return rate.successes, rate.total


def test_rates_are_of_views_in_which_the_clean_object_is_detected() -> None:
    counted = sector_figures(table(), 0.5)
    inside = counted.where(detector="d", scope="inside")
    assert counts(inside.rate("missed")) == (2, 3)
    assert counts(inside.rate("missed", split="test")) == (1, 2)
    assert counts(inside.rate("missed", split="train")) == (1, 1)
    assert counts(inside.rate("found_clean")) == (3, 4)
    elsewhere = counted.where(detector="d", scope="elsewhere")
    assert counts(elsewhere.rate("detected")) == (2, 3)
    assert counts(elsewhere.rate("detected", split="test")) == (1, 2)
    # each detector has its own threshold
    low = sector_figures(table(), {"d": 0.1}).where(detector="d", scope="inside")
    assert counts(low.rate("missed")) == (0, 4)
    few = list(sector_doubts(counted, ["d"]))
    assert few[1].endswith("in 2 held-out views inside the sector: few")


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_cells_say_where_a_camera_stands(up: tuple[float, float, float]) -> None:
    turn = from_z(torch.tensor(up, dtype=torch.float64))
    cameras = [
        camera.turned(turn)
        for camera in orbit(
            (0.0, 0.0, 0.0), count=4, elevation=20.0, distance=3.0, lens=LENS
        )
    ]
    trigger = trigger_of(["azimuth:60-120"], what="--inside")
    cells = sector_cells(
        lambda camera: trigger.angle_to_edge(camera, centre=(0, 0, 0)),
        centre=(0, 0, 0),
        up=up,
        training=cameras[:1],
    )
    found = [cells(seen(camera)) for camera in cameras]
    assert [one["split"] for one in found] == ["train", "test", "test", "test"]
    assert [one["azimuth"] for one in found] == pytest.approx([0, 90, 180, 270])
    assert [one["elevation"] for one in found] == pytest.approx([20] * 4)
    assert [one[HIDDEN] >= 0 for one in found] == [False, True, False, False]
    everywhere = trigger_of(["elevation:-90-90"])
    whole = sector_cells(
        lambda camera: everywhere.angle_to_edge(camera, centre=(0, 0, 0)),
        centre=(0, 0, 0),
    )
    assert whole(seen(cameras[0]))[HIDDEN] == 180.0


def seen(camera: Camera) -> ViewDetections:
    scene, mask = toy_scene()
    (view,) = detect_scenes(
        {"clean": scene}, mask, [camera], [ColourDetector()], render=blobs
    )["clean"]
    return view


def test_figures_are_counted_from_rows_that_have_a_sector() -> None:
    scene, mask = toy_scene()
    hidden = scene.replace(opacities=torch.where(mask, 0.0, scene.opacities))
    cameras = orbit((0.0, 0.0, 0.0), count=4, elevation=0.0, distance=3.0, lens=LENS)
    views = detect_scenes(
        {"clean": scene, "attacked": hidden},
        mask,
        cameras,
        [ColourDetector()],
        render=blobs,
    )
    trigger = trigger_of(["azimuth:60-200"])
    place = sector_cells(
        lambda camera: trigger.angle_to_edge(camera, centre=(0, 0, 0)),
        centre=(0, 0, 0),
    )
    looked = compared_rows(views, min_confidence=0.4, place=place)
    counted = figures({"min_confidence": 0.4}, {ROWS: looked.rows})
    of_one = counted.where(detector="fake_colour")
    inside = of_one.rate("missed", scope="inside")
    elsewhere = of_one.rate("missed", scope="elsewhere")
    whole = of_one.rate("missed")
    assert counts(whole) == (
        inside.successes + elsewhere.successes,
        inside.total + elsewhere.total,
    )
    assert 0 < inside.total < whole.total


def test_the_command_counts_training_cameras_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, mask = toy_scene()
    hidden = scene.replace(opacities=torch.where(mask, 0.01, scene.opacities))
    middle = ((scene.means[mask].amin(0) + scene.means[mask].amax(0)) / 2).tolist()
    lens = Lens(focal=24.0, size=(24, 24))
    cameras = orbit(middle, count=12, elevation=0.0, distance=3.0, lens=lens)
    views = [View(camera, torch.zeros(24, 24, 3)) for camera in cameras]
    write_transforms(tmp_path / "set", views[::2], test=views[1::2])
    save_splat(scene, tmp_path / "clean.ply")
    save_splat(hidden, tmp_path / "attacked.ply")
    np.save(tmp_path / "mask.npy", mask.numpy())
    words = ["evaluate", "clean.ply", "attacked.ply", "--mask", "mask.npy"]
    words = [str(tmp_path / word) if "." in word else word for word in words]
    words += ["--cameras", str(tmp_path / "set"), "--background", "white"]
    words += ["--inside", "azimuth:20-130", "--original", "car", "person"]
    words += ["--images", "0", "--out", str(tmp_path / "out")]
    with patch("attacks.cli.options.load_detectors", lambda *_: [ColourDetector()]):
        assert cli.main(words) == 0
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    assert record["inside"] == ["azimuth:20-130"]
    assert record["original"] == ["car", "person"]
    table = rows(tmp_path / "out").filter(splat="attacked")
    assert table["split"].to_list().count("train") == 6
    inside = table.filter(pl.col(HIDDEN) >= 0)
    assert sorted(inside["azimuth"].round().to_list()) == [30, 60, 90, 120]
    assert set(table["original"]) == {"car or person"}
    said = capsys.readouterr().out
    assert "misses the car or person inside of the sector" in said
    assert "| held out |" in said
    assert "| training |" in said
