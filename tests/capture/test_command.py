"""`mi-splat capture`: what it writes, says and refuses."""

import json
from pathlib import Path

import pytest
import torch

from attacks import cli
from mi_splat.datasets import load_dataset
from tests.capture.test_writer import contents

STILL_LIFE = Path(__file__).parents[2] / "scenes" / "meshes" / "still_life.xml"


def command_line(folder: Path, *more: str) -> list[str]:
    """A quick capture of the still life."""
    quick = ["--size", "16", "--samples", "2", "--points", "200"]
    return ["capture", str(STILL_LIFE), "--out", str(folder), *quick, *more]


def test_the_command_writes_a_set_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "set"
    command = command_line(
        out,
        "--cameras",
        "cap:3@40",
        "--test",
        "2",
        "--format",
        "both",
        "--distance",
        "5",
    )
    assert cli.main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "5 images of 16 x 16 (2 of them held out); 5 rendered" in lines[0]
    assert (
        "200 points; listed in points3D.ply, transforms_train.json,"
        " transforms_test.json, sparse/0/" in lines[1]
    )
    assert len(load_dataset(out)) == 3
    before = contents(out)
    assert cli.main([*command, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["train"], document["test"], document["rendered"]) == (3, 2, 0)
    assert contents(out) == before
    assert cli.main(command_line(out, "--cameras", "cap:3@40")) == 1
    assert "test 2, now 0" in capsys.readouterr().err


def test_the_command_takes_cameras_of_a_file_and_sizes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        cli.main(
            command_line(
                tmp_path / "a", "--cameras", "orbit:2@30", "--size", "20x12", "--rgba"
            )
        )
        == 0
    )
    again = command_line(
        tmp_path / "b", "--cameras", str(tmp_path / "a" / "transforms_train.json")
    )
    again = [word for word in again if word not in ("--size", "16")]
    assert cli.main(again) == 0
    ours, theirs = (load_dataset(tmp_path / name) for name in "ab")
    assert ours.alpha(0) is not None
    assert theirs[0].image.shape == (12, 20, 3)
    assert all(
        torch.equal(a.to_world, b.to_world)
        for a, b in zip(ours.cameras, theirs.cameras, strict=True)
    )


def test_cameras_that_look_past_the_scene_are_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = command_line(
        tmp_path,
        "--cameras",
        "orbit:2@30",
        "--centre",
        "0",
        "0",
        "1e5",
        "--distance",
        "2",
    )
    assert cli.main(command) == 1
    assert (
        "no surface is in view of 2 of 2 cameras, which are 1e+05 world units away"
        in capsys.readouterr().err
    )


def test_pictures_that_are_all_black_are_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "capture",
        "car",
        "--cameras",
        "orbit:2@10",
        "--size",
        "8",
        "--samples",
        "1",
        "--points",
        "9",
    ]
    boxed = tmp_path / "boxed.xml"
    boxed.write_text(
        '<scene version="3.0.0"><integrator type="path"/><emitter'
        ' type="constant"/><shape type="cube"/></scene>'
    )
    inside = [
        "capture",
        str(boxed),
        *command[2:],
        "--distance",
        "0.3",
        "--json",
        "--out",
        str(tmp_path / "in"),
    ]
    for _ in range(2):  # the second time, all images are there
        assert cli.main(inside) == 0
        captured = capsys.readouterr()
        assert "inside the object" in captured.err
        assert "--distance" in json.loads(captured.out)["warnings"][0]
    assert cli.main([*command, "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().err == ""


def test_flags_that_cameras_of_a_file_do_not_follow_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "cameras.json"
    pose = [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 0.5], [0, 0, 0, 1]]
    frames = {
        "camera_angle_x": 0.7,
        "frames": [{"file_path": "a", "transform_matrix": pose}],
    }
    command = command_line(tmp_path / "out", "--cameras", str(file))
    for flag, value in (
        ("--size", ["20"]),
        ("--fov", ["45"]),
        ("--distance", ["3"]),
        ("--centre", ["0", "0", "0"]),
    ):
        file.write_text(
            json.dumps({**frames, "w": 12, "h": 8} if flag == "--size" else frames)
        )
        assert cli.main([*command, flag, *value]) == 1
        captured = capsys.readouterr()
        assert flag in captured.err
        assert len(captured.err.splitlines()) == 1
        assert not (tmp_path / "out").exists()
    assert cli.main(command) == 0  # the size of a file that has none


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--cameras", "sphere:3"], "hemisphere:N"),
        (["--cameras", "hemisphere:1000000000"], "1 to 100000 cameras, got 1000000000"),
        (["--up", "y"], "--up"),
        (["--scale", "2"], "--scale"),
        (["--ground", "road"], "--ground"),
        (["--sun", "40,95"], "sun"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_the_command_refuses_before_it_begins(
    more: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert cli.main(command_line(out, *more)) in (1, 2)
    captured = capsys.readouterr()
    assert says in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("lorry", None, "car_street, stop_sign"),
        ("none.glb", None, "none.glb"),
        ("bad.xml", "<scene", "bad.xml"),
        ("empty.xml", '<scene version="3.0.0"/>', "empty.xml"),
        (
            "splats.xml",
            '<scene version="3.0.0"><integrator type="splat_tile"/></scene>',
            "mi-splat render",
        ),
        (
            "unknown.xml",
            '<scene version="3.0.0"><shape type="teapot"/></scene>',
            "unknown.xml",
        ),
    ],
)
def test_the_command_refuses_scenes(
    name: str,
    content: str | None,
    says: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene = tmp_path / name
    if content is not None:
        scene.write_text(content)
    assert (
        cli.main(
            [
                "capture",
                str(scene) if "." in name else name,
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 1
    )
    captured = capsys.readouterr()
    assert says in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()
