"""`mi-splat render` to folders, patterns and animations, and what it refuses to
write.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from attacks import cli
from mi_splat.io import load_splat, save_splat
from mi_splat.io.camera_records import camera_of, describe
from mi_splat.render.renderer import Renderer, RenderSettings
from tests.fakes import camera, toy_scene
from tests.project.layers import ROOT
from tests.viewer.contents import ball

SMALL = ["--size", "24x16"]
UP_LINE = "mi-splat: up is taken as z (nothing says otherwise); --up -y turns it\n"


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a bare splat, which is the current one."""
    save_splat(toy_scene()[0], tmp_path / "toy.ply")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_many_cameras_make_a_folder(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "render",
        "toy.ply",
        "--cameras",
        "orbit:3@20",
        *SMALL,
        "--out",
        "new/pictures",
    ]
    assert cli.main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    folder = toy / "new" / "pictures"
    assert {path.name for path in folder.iterdir()} == {
        *(f"orbit-{n}.png" for n in range(3)),
        "cameras.json",
        "manifest.json",
    }
    assert [camera["name"] for camera in document["cameras"]] == [
        "orbit-0",
        "orbit-1",
        "orbit-2",
    ]
    assert all((toy / file).is_file() for file in document["files"])
    assert cli.main(words) == 1
    assert "--force" in capsys.readouterr().err
    assert cli.main([*words, "--force"]) == 0
    again = [
        "render",
        "toy.ply",
        "--cameras",
        str(folder / "cameras.json"),
        "--out",
        "again",
    ]
    assert cli.main(again) == 0
    for number in range(3):
        assert (toy / "again" / f"orbit-{number}.png").read_bytes() == (
            folder / f"orbit-{number}.png"
        ).read_bytes()


def channels(file: Path) -> dict[str, np.ndarray]:
    """What Mitsuba reads of an OpenEXR file."""
    bitmap = mi.Bitmap(str(file))
    names = [field.name for field in bitmap.struct_()]
    return dict(zip(names, np.moveaxis(np.array(bitmap), -1, 0), strict=True))


def test_floats_are_those_of_the_renderer(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "render",
        "toy.ply",
        "--azimuth",
        "0",
        "--distance",
        "3",
        *SMALL,
        "--near",
        "0.2",
        "--background",
        "white",
        "--force",
    ]
    assert cli.main([*words, "--alpha", "--depth", "--out", "a.exr", "--json"]) == 0
    layers = channels(toy / "a.exr")
    shot = camera_of(json.loads(capsys.readouterr().out)["cameras"][0])
    seen = Renderer(RenderSettings(background=(1.0, 1.0, 1.0), linear=True)).outputs(
        load_splat("toy.ply"), shot
    )
    wanted = [*seen.image.unbind(-1), seen.alpha, seen.depth, seen.median_depth]
    assert set(layers) == {"R", "G", "B", "A", "Z", "median.Z"}
    for name, plane in zip(("R", "G", "B", "A", "Z", "median.Z"), wanted, strict=True):
        assert np.array_equal(layers[name], plane.numpy())
    assert cli.main([*words, "--alpha", "--method", "ray", "--out", "ray.exr"]) == 0
    assert set(channels(toy / "ray.exr")) == {"R", "G", "B", "A"}


def test_an_orbit_makes_an_animation(toy: Path) -> None:
    assert (
        cli.main(
            [
                "render",
                "toy.ply",
                "--cameras",
                "orbit:4@20",
                *SMALL,
                "--fps",
                "5",
                "--out",
                "a.gif",
            ]
        )
        == 0
    )
    with Image.open(toy / "a.gif") as picture:
        assert (picture.format, getattr(picture, "n_frames", 1), picture.size) == (
            "GIF",
            4,
            (24, 16),
        )
        assert picture.info["duration"] == 200


def test_frames_of_different_sizes_are_no_animation(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (toy / "cameras.json").write_text(
        json.dumps([describe("a", camera(16)), describe("b", camera(20))])
    )
    words = ["render", "toy.ply", "--cameras", "cameras.json", "--out", "a.gif"]
    assert cli.main(words) == 1
    assert (
        "cameras of one size, got 16 x 16, 20 x 20; pass --size"
        in capsys.readouterr().err
    )
    assert cli.main([*words, "--size", "24x16"]) == 0


def test_gaussians_nearer_than_the_near_plane_are_told(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "render",
        "toy.ply",
        "--azimuth",
        "0",
        "--distance",
        "3",
        *SMALL,
        "--force",
        "--near",
    ]
    assert cli.main([*words, "4"]) == 0
    assert "camera orbit: " in (told := capsys.readouterr().err)
    assert "nearer than 4 and not drawn" in told
    assert cli.main([*words, "0.1"]) == 0
    assert capsys.readouterr().err == UP_LINE


@pytest.mark.parametrize(
    "words", [["render"], ["select", "--box", "-9", "-9", "-9", "9", "9", "9"]]
)
def test_cameras_that_see_no_gaussian_are_warned_of(
    toy: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    command, *more = words
    call = [
        command,
        "toy.ply",
        "--force",
        *more,
        *SMALL,
        "--out",
        "a.gif" if command == "render" else "a.png",
    ]
    assert (
        cli.main(
            [
                *call,
                "--cameras",
                "orbit:3@20",
                "--centre",
                "0",
                "0",
                "1e5",
                "--distance",
                "2",
            ]
        )
        == 0
    )
    told = capsys.readouterr().err
    assert (
        "no Gaussian is in view of 3 of 3 cameras, which are 1e+05 world units away"
        in told
    )
    assert "--up" in told
    assert cli.main([*call, "--cameras", "orbit:3@20"]) == 0
    assert "in view" not in capsys.readouterr().err


def test_a_camera_may_have_any_name(toy: Path) -> None:
    entry = describe("left/up: 1", camera(16))
    (toy / "cameras.json").write_text(json.dumps([entry]))
    assert (
        cli.main(
            ["render", "toy.ply", "--cameras", "cameras.json", "--out", "pictures"]
        )
        == 0
    )
    assert {path.name for path in (toy / "pictures").iterdir()} == {
        "left_up__1.png",
        "cameras.json",
        "manifest.json",
    }
    assert (
        json.loads((toy / "pictures" / "cameras.json").read_text())[0]["name"]
        == "left/up: 1"
    )


# `mi-splat view`: what it refuses before anything is loaded, the page that it writes,
# and how it ends


@pytest.fixture
def splat(tmp_path: Path) -> Path:
    save_splat(ball((0.8, 0.3, 0.1)), tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


@pytest.mark.slow
def test_it_serves_until_it_is_told_to_stop(splat: Path) -> None:
    pytest.importorskip("viser", reason="needs the extra `view`")
    command = [
        sys.executable,
        "-m",
        "attacks",
        "view",
        str(splat),
        "--port",
        "0",
        "--no-open",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command,
        cwd=splat.parent,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().removeprefix("Open ").strip()
            assert address.startswith("http://127.0.0.1:"), address
            with urllib.request.urlopen(address, timeout=60) as answer:
                assert answer.status == 200
            process.send_signal(signal.SIGTERM)
            out, errors = process.communicate(timeout=120)
        finally:
            process.kill()
    assert (process.returncode, errors) == (0, UP_LINE)
    assert out.splitlines()[-1] == "The page is closed."
    port = int(address.partition("?")[0].rstrip("/").rpartition(":")[2])
    with socket.socket() as free:
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        free.bind(("127.0.0.1", port))
