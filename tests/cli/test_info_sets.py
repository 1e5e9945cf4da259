"""`mi-splat info SET`: where the cameras of a set of photographs stand."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from attacks import cli
from mi_splat.cameras.camera import View
from mi_splat.cameras.framing import looked_at
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.io import save_splat
from mi_splat.maths.orientation import turn_of
from tests.datasets.sets import write_transforms
from tests.fakes import toy_scene

CENTRE = (1.0, 2.0, 0.5)
LENS = Lens(focal=20.0, size=(16, 12))


def write_orbit(folder: Path, up: str = "z") -> None:
    """Eight images from 30 degrees above a point, the first two of them held out."""
    cameras = orbit(CENTRE, count=8, elevation=30.0, distance=4.0, lens=LENS)
    back = torch.from_numpy(turn_of(up)).T  # type: ignore[arg-type]
    views = [View(one.turned(back), torch.zeros(12, 16, 3)) for one in cameras]
    write_transforms(folder, views[2:], test=views[:2])


def info(*words: str, capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    assert cli.main(["info", *words, "--json"]) == 0
    document: dict[str, object] = json.loads(capsys.readouterr().out)
    return document


@pytest.mark.parametrize("up", ["z", "-y"])
def test_each_camera_has_its_direction(
    up: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_orbit(tmp_path / "set", up)
    document = info(str(tmp_path / "set"), capsys=capsys)
    assert (document["photographs"], document["placed"]) == (8, 8)
    assert (document["held_out"], document["missing"]) == (2, 0)
    axis = [0.0, 0.0, 1.0] if up == "z" else [0.0, -1.0, 0.0]
    assert document["up"] == axis
    middle = np.array(CENTRE) @ turn_of(up)  # type: ignore[arg-type]
    assert document["centre"] == pytest.approx(middle.tolist(), abs=1e-4)
    cameras = document["cameras"]
    assert isinstance(cameras, list)
    azimuths = sorted(one["azimuth"] % 360 for one in cameras)
    steps = np.diff(azimuths)
    assert steps == pytest.approx([45.0] * 7, abs=1e-3)
    for one in cameras:
        assert one["elevation"] == pytest.approx(30.0, abs=1e-3)
        assert one["distance"] == pytest.approx(4.0, abs=1e-4)
    assert sum(one["split"] == "test" for one in cameras) == 2


def test_directions_around_another_centre(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_orbit(tmp_path / "set")
    words = [str(tmp_path / "set"), "--centre", "1", "2", "0"]
    document = info(*words, capsys=capsys)
    assert document["centre"] == [1, 2, 0]
    cameras = document["cameras"]
    assert isinstance(cameras, list)
    assert cameras[0]["elevation"] > 31
    scene, mask = toy_scene()
    save_splat(scene, tmp_path / "a.ply")
    np.save(tmp_path / "mask.npy", mask.numpy())
    words = ["--splat", str(tmp_path / "a.ply"), "--mask", str(tmp_path / "mask.npy")]
    document = info(str(tmp_path / "set"), *words, capsys=capsys)
    means = scene.means[mask]
    middle = (means.amin(0) + means.amax(0)) / 2
    assert document["centre"] == pytest.approx(middle.tolist(), abs=0.1)
    assert document["centre_is"] == "the middle of the object"


def test_a_table_for_a_human(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_orbit(tmp_path / "set")
    assert cli.main(["info", str(tmp_path / "set"), "--up", "z"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[3] == "up           z"
    assert "placed       8, of which 2 are held out (test)" in lines
    assert len([line for line in lines if "_0000" in line]) == 8


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["a.ply", "--centre", "0", "0", "0"], "expected a set of photographs"),
        (["a.ply", "--up=-y"], "expected a set of photographs"),
        (["set", "--splat", "a.ply"], "which Gaussians are meant"),
        (
            ["set", "--splat", "a.ply", "--centre", "0", "0", "0"],
            "expected none with --splat",
        ),
    ],
)
def test_what_is_refused(
    words: list[str],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_orbit(tmp_path / "set")
    save_splat(toy_scene()[0], tmp_path / "a.ply")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["info", *words]) in (1, 2)
    assert told in " ".join(capsys.readouterr().err.split())


def test_the_point_that_cameras_look_at() -> None:
    cameras = orbit(CENTRE, count=3, elevation=10.0, distance=2.0, lens=LENS)
    assert looked_at(cameras).tolist() == pytest.approx(CENTRE, abs=1e-5)
