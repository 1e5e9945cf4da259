"""Damaged files of other people are read or refused in words, whatever was done to them."""

import contextlib
import json
import re
import shutil
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from attacks.detectors.weights import apply_weights, read_weights
from attacks.studies import study_file
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.datasets.frames import read_picture
from mi_splat.datasets.transforms import read_cameras
from mi_splat.errors import MiSplatError
from mi_splat.io.camera_records import describe, recorded_cameras
from mi_splat.io.points import load_points
from mi_splat.io.splat_files import load_splat, save_splat
from mi_splat.scene_files import open_scene
from tests.capture.trucks import truck, write_glb
from tests.cloak.tiny_study import study_in
from tests.fakes import camera
from tests.io.format_files import tame_scene, valid
from tests.io.ply_files import LISTS, ROWS, encoded, listed
from tests.project.layers import ROOT

POSE = [[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0.5], [0, 0, 0, 1]]
FRAMES = [{"file_path": f"images/{number}.png", "transform_matrix": POSE, "k1": 0} for number in range(2)]
TRANSFORMS = {"camera_angle_x": 0.7, "w": 64, "h": 48, "frames": FRAMES}
SPLATS = ("a.ply", "a.compressed.ply", "a.glb", "a.sog", "a.splat", "v2.spz", "v3.spz", "v4.spz")
SCENE = [f"stop_sign{part}" for part in (".xml", ".json", "_roadside.ply", "_stop_sign.ply")]
MUTANTS, SECONDS = 150, 10.0
"""Damaged files of each kind, and the time that one may take."""


def _camera_file(path: Path) -> None:
    if recorded_cameras(path) is None:
        read_cameras(path, (64, 48))


def _weights(path: Path) -> None:
    apply_weights(torch.nn.Linear(3, 2), read_weights(path), path)


READERS: dict[str, Callable[[Path], object]] = {
    **dict.fromkeys((*SPLATS, "text.ply", "lists.ply"), load_splat),
    "points.ply": load_points,
    **dict.fromkeys(("cameras.json", "transforms.json"), _camera_file),
    **dict.fromkeys(("w.safetensors", "w.pth"), _weights),
    "truck.glb": load_mesh,
    **dict.fromkeys(("p.png", "p.jpg"), lambda path: read_picture(path, downscale=1, background=(0.0, 0.0, 0.0))),
    "stop_sign.xml": open_scene,
    "cloak_demo.toml": study_in,
    "transfer.toml": study_file.read_study,
}
"""A file's name to what reads it, as the commands do."""


def made(name: str, folder: Path) -> Path:
    """A valid file of a kind."""
    path, state = folder / name, torch.nn.Linear(3, 2).state_dict()
    if name == "stop_sign.xml":
        for part in SCENE:
            shutil.copy(ROOT / "scenes" / part, folder)
    elif name.endswith(".toml"):
        shutil.copy(next((ROOT / "scenes").rglob(name)), path)
    elif name in ("cameras.json", "transforms.json"):
        path.write_text(json.dumps([describe("left", camera())] if name == "cameras.json" else TRANSFORMS))
    elif name.startswith("w."):
        (save_file if name.endswith(".safetensors") else torch.save)(state, path)
    elif name.startswith("p."):
        Image.radial_gradient("L").resize((16, 12)).convert("RGB").save(path)
    elif name == "truck.glb":
        write_glb(folder, truck())
    elif name in ("text.ply", "points.ply"):
        path.write_bytes(encoded(ROWS[:5], "ascii" if name == "text.ply" else "binary_little_endian"))
    elif name == "lists.ply":
        path.write_bytes(listed("binary_little_endian", ROWS[:5], LISTS[:5]))
    elif name == "a.ply":
        save_splat(tame_scene(5, 1), path)
    else:
        path.write_bytes(valid(name))
    return path


WORDS = b'NaN inf -1 0 1e999 99999999999999999999 [] {} "" \xff ../../x'.split()
WORD = re.compile(rb'-?\d[\d.eE+-]*|"[^"\n]*"|[A-Za-z_]+')


def damaged(data: bytes, random: Random) -> bytes:
    """A file with bytes flipped, cut, repeated or overwritten, or with a word of its first part replaced."""
    start, other = random.randrange(len(data)), random.randrange(len(data))
    match random.randrange(5):
        case 0:
            return data[:start]
        case 1:
            return data[:start] + data[other : other + 64] + data[start:]
        case 2:
            return data[:start] + random.choice((b"\xff" * 4, b"\0" * 4, b"\0\0\0\x40")) + data[start + 4 :]
        case 3 if words := list(WORD.finditer(data[:20_000])):
            word = random.choice(words)
            return data[: word.start()] + random.choice(WORDS) + data[word.end() :]
    return data[:start] + bytes([data[start] ^ 1 << random.randrange(8)]) + data[start + 1 :]


class TooSlowError(BaseException):
    """A reader took too long; no reader catches it."""


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """No more than `SECONDS`."""

    def ended(*_: object) -> None:
        raise TooSlowError(f"more than {SECONDS} s")

    before = signal.signal(signal.SIGALRM, ended)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.nightly
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    path = made(name, tmp_path)
    whole, random = path.read_bytes(), Random(f"11 {name}")
    READERS[name](path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(MUTANTS):
            path.write_bytes(damaged(whole, random))
            with contextlib.suppress(MiSplatError), limited():
                READERS[name](path)


DEEP, LONG = "[" * 100_000, "9" * 10_000
"""Texts that stand in a document as they are."""


def put(*path: str | int, value: Any) -> Callable[[Any], Any]:
    """Another value at a place."""

    def change(document: Any) -> Any:
        inner = document
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value
        return document

    return change


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("cameras.json", put(0, "to_world", value="DEEP")),
        ("cameras.json", lambda values: [7]),
        ("cameras.json", lambda values: [None]),
        ("cameras.json", put(0, "focal", value=[[1], [2]])),
        ("cameras.json", put(0, "size", value=[1e300, 4])),
        ("cameras.json", put(0, "size", value=["LONG", 4])),
        ("cameras.json", put(0, "name", value={})),
        ("cameras.json", lambda _: [{"rotation": "x", "position": {}, "fx": 1, "fy": 1, "width": 2, "height": 2}]),
        ("cameras.json", lambda values: {"views": [{"camera": 7}]}),
        ("cameras.json", lambda values: {"views": [{"camera": values[0]}], "cameras": 7}),
        ("cameras.json", lambda values: {"reference": []}),
        ("transforms.json", put("frames", 0, "transform_matrix", value={"a": 1})),
        ("transforms.json", put("w", value="LONG")),
    ],
)
def test_broken_documents_are_refused_in_words(name: str, change: Callable[[Any], Any], tmp_path: Path) -> None:
    path = made(name, tmp_path)
    text = json.dumps(change(json.loads(path.read_text())))
    path.write_text(text.replace('"DEEP"', DEEP).replace('"LONG"', LONG))
    with pytest.raises(MiSplatError, match=r": expected .*; \w"):
        READERS[name](path)


@pytest.mark.parametrize("name", ["cloak_demo.toml", "transfer.toml"])
@pytest.mark.parametrize(
    "text", ["x = " + "[" * 5000, "x." * 2000 + "y = 1", "seeds = " + "9" * 10_000, "\xff", "a = nan"]
)
def test_broken_tables_are_refused_in_words(name: str, text: str, tmp_path: Path) -> None:
    path = made(name, tmp_path)
    path.write_bytes(text.encode("latin-1") + b"\n" + path.read_bytes())
    with pytest.raises(MiSplatError, match=r": expected .*; \w"):
        READERS[name](path)
