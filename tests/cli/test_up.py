"""The line of a command that says which way is taken for up, and the flag that turns
it.
"""

from pathlib import Path

import pytest

from attacks import cli
from mi_splat.cli.console import note, show_notes
from mi_splat.io import save_splat
from mi_splat.io.camera_records import recorded_cameras
from tests.fakes import toy_scene

LINE = "up is taken as -y (as its comment says); --up y turns it"
BOX = ["--box", "-9", "-9", "-9", "9", "9", "9"]
SMALL = ["--size", "24x16"]
COMMANDS = {
    "render": ["--cameras", "orbit:2@20", *SMALL, "--out", "seen"],
    "select": [*BOX, *SMALL],
    "compare": [
        "--methods",
        "tile,ray",
        *SMALL,
        "--rounds",
        "0",
        "--no-gradients",
        "--out",
        "compared",
    ],
    "audit": [],
}


@pytest.fixture
def commented(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A splat in the current folder that says where its up is, as Brush writes it."""
    path = tmp_path / "a.ply"
    save_splat(toy_scene()[0], path)
    lines = b"comment Exported from Brush\ncomment Vertical axis: y\n"
    path.write_bytes(
        path.read_bytes().replace(b"element vertex", lines + b"element vertex", 1)
    )
    monkeypatch.chdir(tmp_path)
    return path


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_says_once_which_way_is_up(
    command: str, commented: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([command, commented.name, *COMMANDS[command]]) == 0
    told = capsys.readouterr().err.splitlines()
    assert [line for line in told if "up is" in line] == [f"mi-splat: {LINE}"]


def test_info_tells_it_with_the_facts(
    commented: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["info", commented.name]) == 0
    (line,) = [
        line for line in capsys.readouterr().out.splitlines() if line.startswith("up ")
    ]
    assert line.split(maxsplit=1)[1] == "-y (as its comment says); --up y turns it"


def test_the_flag_turns_it_and_cameras_that_have_their_places_need_none(
    commented: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["render", commented.name, *COMMANDS["render"]]
    assert cli.main(words) == 0
    from_comment = recorded_cameras(Path("seen/cameras.json"))
    assert cli.main([*words, "--force", "--up", "-y"]) == 0
    from_flag = recorded_cameras(Path("seen/cameras.json"))
    assert from_comment is not None
    assert from_flag is not None
    for name, camera in from_comment.items():
        # what points down in the image is y of the file
        assert float(camera.to_world[1, 1]) > 0.5
        assert (camera.to_world - from_flag[name].to_world).abs().max() < 1e-12
    capsys.readouterr()
    assert (
        cli.main(
            [
                "render",
                commented.name,
                "--cameras",
                "seen/cameras.json",
                "--out",
                "again",
            ]
        )
        == 0
    )
    assert "up is" not in capsys.readouterr().err


def test_a_command_that_fails_says_what_failed_alone(
    capsys: pytest.CaptureFixture[str],
) -> None:
    note("up")
    show_notes(succeeded=False)
    show_notes(succeeded=True)
    assert capsys.readouterr().err == ""
