"""Every command looks at where it shall write before it works, and never writes over
something else without a word.
"""

import contextlib
import importlib
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from attacks import cli
from mi_splat.fields import Output, field_type, type_hints
from mi_splat.io import save_splat
from mi_splat.io.documents import LOCK
from mi_splat.io.folders import MANIFEST, new_folder
from tests.capture.trucks import truck, write_glb
from tests.cli.test_scenes import XML
from tests.fakes import toy_scene
from tests.gaussians import random_scene
from tests.training.sets import write_set

COMMANDS = {
    "capture truck.glb --size 16": ("", "mi_splat.capture.writer.write_capture"),
    "prepare set/images": ("", "mi_splat.preparation.prepare.take_photographs"),
    "train set": ("", "mi_splat.training.resume.train"),
    "render a.ply": ("a.png", "mi_splat.cli.cameras.renderer_of"),
    "render a.ply --cameras orbit:3@20": ("", "mi_splat.cli.cameras.renderer_of"),
    "render a.ply --cameras orbit:2@20": ("a.gif", "mi_splat.cli.cameras.renderer_of"),
    "compare a.ply": ("", "attacks.studies.compare.compare"),
    "select a.ply --cluster 1": ("a.npy", "mi_splat.cli.cameras.choose"),
    "dagger a.ply --cluster 1": ("", "attacks.dagger.attack.attack_views"),
    "dagger --region a.ply --cluster 1": ("", "attacks.dagger.attack.attack_views"),
    "study run study.toml": ("", "attacks.cli.study.engine_of"),
    "cloak study.toml": ("", "attacks.cli.study.engine_of"),
    "artifact set": ("", "attacks.report.checking.pack"),
    "detect a.ply": ("", "attacks.cli.options.load_detectors"),
    "evaluate a.ply b.ply": ("", "attacks.cli.options.load_detectors"),
}
"""Commands that write: the file in a folder that --out names, or none, and what must
not be reached.
"""
GOES_ON = ("capture", "train", "study", "bench", "cloak")
"""Commands whose folder is continued by the same command, so that none of it has to be
replaced.
"""
STUDY = 'name = "s"\n[[attack]]\nname = "above"\nelevation = [40, 90]\n'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the commands read."""
    monkeypatch.chdir(tmp_path)
    write_glb(tmp_path, truck())
    write_set(tmp_path / "set")
    save_splat(random_scene(60), tmp_path / "a.ply")
    save_splat(random_scene(60), tmp_path / "b.ply")
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


@contextlib.contextmanager
def taken(folder: Path) -> Iterator[None]:
    """A folder that is locked as by another process."""
    import fcntl

    folder.mkdir()
    with (folder / LOCK).open("w") as file:
        json.dump(
            {
                "command": "mi-splat train other",
                "process": 7,
                "host": "there",
                "since": "noon",
            },
            file,
        )
        file.flush()
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def forbid(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let what would take long fail."""

    def reached(*_: object, **__: object) -> Any:
        raise AssertionError("work was begun")

    module, _, attribute = name.rpartition(".")
    monkeypatch.setattr(importlib.import_module(module), attribute, reached)


@pytest.mark.parametrize("line", COMMANDS)
def test_what_is_in_the_way_is_seen_before_any_work(
    line: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A file, a folder of something else, and a folder that another process works
    in.
    """
    name, work = COMMANDS[line]
    forbid(work, monkeypatch)
    assert cli.main([*line.split(), "--out", "example:car_street"]) == 2
    assert (
        "--out: expected a path to write, got the scene example:car_street"
        in capsys.readouterr().err
    )
    (folder / "file").write_text("precious")
    assert cli.main([*line.split(), "--out", str(folder / "file" / "deep" / name)]) == 1
    assert str(folder / "file") in capsys.readouterr().err
    assert (folder / "file").read_text() == "precious"
    if name:
        return
    (folder / "album").mkdir()
    (folder / "album" / "wedding.jpg").write_text("dear")
    assert cli.main([*line.split(), "--out", str(folder / "album")]) == 1
    assert "album" in capsys.readouterr().err
    assert [path.name for path in (folder / "album").iterdir()] == ["wedding.jpg"]
    with taken(folder / "out"):
        assert cli.main([*line.split(), "--out", str(folder / "out")]) == 1
        assert (
            "in use by `mi-splat train other`, process 7 on there, since noon"
            in capsys.readouterr().err
        )
    assert [path.name for path in (folder / "out").iterdir()] == [LOCK]


@pytest.mark.parametrize(
    "line",
    [
        "render a.ply --size 16 --out out/a.png",
        "render a.ply --size 16 --cameras orbit:2@20 --out out/a.gif",
        "select a.ply --cluster 1 --size 16 --out out/a.npy",
        "convert a.ply out/b.glb",
    ],
)
def test_what_a_killed_call_left_beside_a_file_is_swept(
    line: str, folder: Path
) -> None:
    (folder / "out").mkdir()
    left = folder / "out" / ".0123456789abcdef.tmp"
    left.write_text("half an image")
    os.utime(left, (time.time() - 90_000,) * 2)
    assert cli.main(line.split()) == 0
    assert len(list((folder / "out").iterdir())) == 1


def test_a_result_is_replaced_only_when_forced(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["dagger", "a.ply", "--cluster", "1", "--out", "out"]
    with new_folder(folder / "out") as made:
        (made / "result.json").write_text("{}")
    forbid("attacks.dagger.attack.attack_views", monkeypatch)
    assert cli.main(words) == 1
    assert "replace this result with force (--force)" in capsys.readouterr().err
    with pytest.raises(AssertionError, match="work was begun"):
        cli.main([*words, "--force"])
    assert (folder / "out" / "result.json").read_text() == "{}"


def outputs_of(command: str) -> dict[str, Any]:
    """The options of a command that name what it writes, stores of many runs apart, and
    their types.
    """
    kind = cli._command(command, ())["kind"]
    hints = {name: field_type(hint) for name, hint in type_hints(kind).items()}
    inner = {
        name: field_type(hint.args[0])
        for name, hint in hints.items()
        if hint.origin is tuple
    }
    written = {
        name: hint
        for name, hint in {**hints, **inner}.items()
        if Output() in hint.marks
    }
    return {
        name: hint for name, hint in written.items() if name not in ("store", "stages")
    }


@pytest.mark.parametrize("command", [name for name in cli.COMMANDS if outputs_of(name)])
def test_every_command_that_writes_takes_force_or_goes_on(command: str) -> None:
    fields = type_hints(cli._command(command, ())["kind"])
    assert ("force" in fields) != (command in GOES_ON)


LINES = {
    "render a.ply --size 16 --out {}.png": "a file",
    "render a.ply --size 16 --out {}.exr": "a file",
    "render a.ply --size 16 --cameras orbit:2@20 --out {}.gif": "a file",
    "render a.ply --size 16 --cameras orbit:2@20 --out {}": "pictures",
    "select a.ply --cluster 1 --size 16 --out {}.png": "a file",
    "select a.ply --cluster 1 --size 16 --out mask.npy {}.npy": "a file",
    "convert a.ply {}.glb": "a file",
    "audit a.ply --only lint --out {}": "a result",
    "audit a.ply --repair {}.ply": "a file",
    "bound a.ply --out {}.ply": "a file",
    "gate a.ply --only lint --store store --sarif {}.sarif": "a file",
    "report result --out {}.html": "a file",
    "conform result --out {}": "a result",
    "conform --export {}": "a result",
    "poison set set2 --out {}": "a set",
    "prepare set/images --out {}": "a prepared set",
    "compare a.ply --out {}": "a result",
    "detect a.ply --out {}": "a result",
    "evaluate a.ply b.ply --out {}": "a result",
    "artifact result --out {}": "a result",
    "dagger a.ply --cluster 1 --out {}": "a result",
    "dagger --region a.ply --cluster 1 --out {}": "a result",
    "demo --out {}": "a result",
}
"""Commands with what they would replace; one for each command that takes --force, and
more for files.
"""


def test_every_command_that_takes_force_is_tried() -> None:
    tried = {cli.command_of(line.split())[0] for line in LINES}
    fields = {
        name: type_hints(cli._command(name, ())["kind"])
        for name in cli.COMMANDS
        if outputs_of(name)
    }
    assert {name for name, hints in fields.items() if "force" in hints} == tried


@pytest.mark.parametrize("line", LINES)
def test_what_is_there_is_replaced_only_with_force(
    line: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kind = LINES[line]
    words = line.format("old").split()
    (old,) = (folder / word for word in words if word.startswith("old"))
    with new_folder(folder / "result") as made:
        (made / "result.json").write_text("{}")
    if kind == "a file":
        old.write_text("precious")
    else:
        records = {"a result": "result.json", "pictures": "cameras.json"}
        records |= {"a set": "poison.json", "a prepared set": "prepare.json"}
        record = records[kind]
        with new_folder(old, record=record) as made:
            (made / record).write_text("precious")
    assert cli.main(words) == 1
    error = capsys.readouterr().err
    assert "(--force)" in error, error
    assert str(old.name) in error
    if old.is_file():
        kept = old
    else:
        kept = next(path for path in old.iterdir() if path.name != MANIFEST)
    assert kept.read_text() == "precious"


# What commands refuse: in one line, with the right status, and with every file as it
# was


SMALL = ["--size", "24x16"]


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    scene, _ = toy_scene()
    save_splat(scene, tmp_path / "a.ply")
    save_splat(scene.select(slice(0, 20)), tmp_path / "half.ply")
    (tmp_path / "link.ply").symlink_to("a.ply")
    (tmp_path / "link.png").symlink_to("a.ply")
    (tmp_path / "scene.xml").write_text(XML.replace("cloud.ply", "a.ply"))
    for name, text in {
        "bad.ply": "ply or not",
        "scene.csv": "x,y,z",
        "old.html": "no splat",
    }.items():
        (tmp_path / name).write_text(text)
    np.save(tmp_path / "m.npy", np.arange(3))
    Image.new("RGB", (8, 8)).save(tmp_path / "photo.png")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "attacks.cli.options.load_detectors", lambda *_: pytest.fail("loaded")
    )
    return tmp_path


REFUSED = {
    "select a.ply --cluster 1 --out a.ply": (
        1,
        "a.ply: expected another file than the input",
    ),
    "info bad.ply": (1, "bad.ply"),
    "render a.ply --out link.png": (1, "another file than the input"),
    "render a.ply --cameras orbit:2@0 --out a.png": (
        1,
        "room for 2 images, got a.png; name a folder, or a .gif",
    ),
    "render a.ply --out a.tga": (
        1,
        "a name that ends in .png, .jpg, .exr, .gif or .webp, or a folder",
    ),
    "render a.ply --out a.gif": (
        1,
        "two cameras or more for an animation, got one, a.gif; pass for instance",
    ),
    "render a.ply --cameras orbit:2@0 --out a.ply/b": (1, "a.ply"),
    "render scene.xml --cameras back": (1, "front, side"),
    "render a.ply --cameras back": (1, "no cameras"),
    "render a.ply --depth --out a.png": (
        1,
        "--out with --depth: expected a name that ends in .exr",
    ),
    "render a.ply --depth --method ray --out b.exr": (
        1,
        "--depth: expected --method tile",
    ),
    "select a.ply": (1, "(--object, --box, --click"),
    "select a.ply --box 9 9 9 8 8 8": (2, "first number above its second"),
    "select a.ply --box 90 90 90 91 91 91": (1, "at least one Gaussian, got none of"),
    "select a.ply --click 5000,3": (1, "a pixel of 640 x 480, got 5000,3"),
    "select a.ply --click 0,0": (1, "a pixel that shows something"),
    "select a.ply --cluster 999999": (1, "cluster: expected 1 to"),
    "select a.ply --object car": (1, "one of a, got car"),
    "select a.ply --cluster 1 --out mask.txt": (1, ".png, .jpg, .npy or .ply"),
    "dagger a.ply --out o": (
        1,
        "selection: expected which Gaussians are meant, got nothing",
    ),
    "dagger a.ply --cluster 1 --cameras behind --out o": (
        1,
        "camera: expected no name",
    ),
    "render scene.csv": (1, "a name that ends in .ply"),
    "convert a.ply link.ply --force": (1, "another file than the input"),
    "convert a.ply w.sog --spz-version 2": (
        1,
        "--spz-version: expected a file to write that ends in .spz, got .sog",
    ),
    "convert a.ply b.txt": (1, "a name that ends in"),
    "convert none.ply b.spz": (1, "No such file"),
    "detect": (2, "images, splats or scenes"),
    "detect gone.png --out o": (1, "gone.png"),
    "detect photo.png --cameras orbit:3@20": (2, "images only, and --cameras"),
    "evaluate a.ply a.ply": (1, "one that differs from the other"),
    "evaluate a.ply half.ply": (1, "the same Gaussians in both, got 40 and 20"),
    "evaluate a.ply half.ply --target unicorn": (
        1,
        "tv, train, suitcase for fasterrcnn_small, got unicorn",
    ),
    "view a.ply --port 0 --clean half.ply": (
        1,
        "the scenes: expected the same Gaussians in both",
    ),
    "view a.ply --port 0 --weights w.safetensors": (1, "name it with --detectors"),
    "view a.ply --port 0 --clean none.ply": (1, "none.ply"),
    **{
        f"view {path} --port 0": (1, ": expected ")
        for path in ("none.ply", "none", "old.html", ".")
    },
}


@pytest.mark.parametrize("line", REFUSED)
def test_refused_with_nothing_lost(
    line: str, inputs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in inputs.iterdir()}
    status, words = REFUSED[line]
    assert cli.main(line.split()) == status
    error = capsys.readouterr().err
    assert words in error
    assert len(error.splitlines()) == 1
    assert {path: path.read_bytes() for path in inputs.iterdir()} == before


def test_all_cameras_of_a_bare_splat_are_the_usual_one(
    inputs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["render", "a.ply", *SMALL, "--out", "one.png"]) == 0
    assert (
        cli.main(["render", "a.ply", *SMALL, "--cameras", "all", "--out", "all.png"])
        == 0
    )
    assert "no cameras of its own" in capsys.readouterr().err
    assert (inputs / "one.png").read_bytes() == (inputs / "all.png").read_bytes()
