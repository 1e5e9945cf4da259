"""Damaged files of other people are read or refused in words and within bounds,
whatever was done to them.
"""

import contextlib
import gzip
import json
import re
import shutil
import signal
import tracemalloc
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
from mi_splat.io.errors import SplatFileError
from mi_splat.io.points import load_points
from mi_splat.io.splat_files import load_splat
from mi_splat.render.scene_files import open_scene
from mi_splat.scene import GaussianScene
from tests.capture.trucks import truck, write_glb
from tests.cloak.tiny_study import study_in
from tests.fakes import camera
from tests.io.format_files import valid
from tests.io.ply_files import (
    BODY,
    FACE,
    HEAD,
    LINE,
    LISTS,
    ROWS,
    TEXT_HEAD,
    encoded,
    listed,
    with_elements,
)
from tests.project.layers import ROOT

POSE = [[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0.5], [0, 0, 0, 1]]
FRAMES = [
    {"file_path": f"images/{number}.png", "transform_matrix": POSE, "k1": 0}
    for number in range(2)
]
TRANSFORMS = {"camera_angle_x": 0.7, "w": 64, "h": 48, "frames": FRAMES}
PLY = {
    "a.ply": HEAD + BODY,
    "faces.ply": with_elements(FACE, b"\0\0"),
    "text.ply": TEXT_HEAD + LINE * 40,
    "lists.ply": listed("binary_little_endian", ROWS[:5], LISTS[:5]),
    "lists_in_text.ply": listed("ascii", ROWS[:5], LISTS[:5]),
}
PACKED = ("a.compressed.ply", "a.glb", "a.sog", "a.splat", "v2.spz", "v3.spz", "v4.spz")
INSIDE = {"inside_v2.spz": "v2.spz", "inside_v3.spz": "v3.spz"}
"""Files whose damage is inside of a valid gzip stream."""
SPLATS = (*PLY, *PACKED, *INSIDE)
SCENE = [
    f"stop_sign{part}" for part in (".xml", ".json", "_roadside.ply", "_stop_sign.ply")
]
MUTANTS = 50
SECONDS = 10.0
MEMORY = 24 << 20
"""Damaged files of each kind, the time that one may take, and the memory that one of a
splat may.
"""


def _splat(path: Path) -> GaussianScene | None:
    """The scene, checked; None if the file was refused with our error."""
    tracemalloc.start()
    try:
        scene = GaussianScene(*load_splat(path, on_invalid="drop").tensors())
    except SplatFileError as error:
        words = rf"{re.escape(str(path))}.*: expected .+, got .+; .+"
        assert re.match(words, str(error), re.DOTALL)  # noqa: PT017
        assert len(str(error)) < len(str(path)) + 400  # noqa: PT017
        scene = None
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < MEMORY
    return scene


def _camera_file(path: Path) -> None:
    if recorded_cameras(path) is None:
        read_cameras(path, (64, 48))


def _weights(path: Path) -> None:
    apply_weights(torch.nn.Linear(3, 2), read_weights(path), path)


READERS: dict[str, Callable[[Path], object]] = {
    **dict.fromkeys(SPLATS, _splat),
    "points.ply": load_points,
    **dict.fromkeys(("cameras.json", "transforms.json"), _camera_file),
    **dict.fromkeys(("w.safetensors", "w.pth"), _weights),
    "truck.glb": load_mesh,
    **dict.fromkeys(
        ("p.png", "p.jpg"),
        lambda path: read_picture(path, downscale=1, background=(0.0, 0.0, 0.0)),
    ),
    "stop_sign.xml": open_scene,
    "cloak_demo.toml": study_in,
    "transfer.toml": study_file.read_study,
}
"""A file's name to what reads it, as the commands do."""


def made(name: str, folder: Path) -> Path:
    """A valid file of a kind."""
    path = folder / name
    state = torch.nn.Linear(3, 2).state_dict()
    if name == "stop_sign.xml":
        for part in SCENE:
            shutil.copy(ROOT / "scenes" / part, folder)
    elif name.endswith(".toml"):
        shutil.copy(next((ROOT / "scenes").rglob(name)), path)
    elif name in ("cameras.json", "transforms.json"):
        path.write_text(
            json.dumps(
                [describe("left", camera())] if name == "cameras.json" else TRANSFORMS
            )
        )
    elif name.startswith("w."):
        (save_file if name.endswith(".safetensors") else torch.save)(state, path)
    elif name.startswith("p."):
        Image.radial_gradient("L").resize((16, 12)).convert("RGB").save(path)
    elif name == "truck.glb":
        write_glb(folder, truck())
    elif name == "points.ply":
        path.write_bytes(encoded(ROWS[:5], "binary_little_endian"))
    else:
        path.write_bytes(PLY.get(name) or valid(INSIDE.get(name, name)))
    return path


WORDS = b'NaN inf -1 0 1e999 99999999999999999999 [] {} "" \xff ../../x'.split()
WORD = re.compile(rb'-?\d[\d.eE+-]*|"[^"\n]*"|[A-Za-z_]+')


def damaged(data: bytes, random: Random) -> bytes:
    """A file with bytes flipped, cut, repeated or overwritten, or with a word of its
    first part replaced.
    """
    start = random.randrange(len(data))
    other = random.randrange(len(data))
    match random.randrange(5):
        case 0:
            return data[:start]
        case 1:
            return data[:start] + data[other : other + 64] + data[start:]
        case 2:
            return (
                data[:start]
                + random.choice((b"\xff" * 4, b"\0" * 4, b"\0\0\0\x40"))
                + data[start + 4 :]
            )
        case 3 if words := list(WORD.finditer(data[:20_000])):
            word = random.choice(words)
            return data[: word.start()] + random.choice(WORDS) + data[word.end() :]
    return (
        data[:start]
        + bytes([data[start] ^ 1 << random.randrange(8)])
        + data[start + 1 :]
    )


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


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in SPLATS else pytest.mark.nightly)
        for name in READERS
    ],
)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    path = made(name, tmp_path)
    whole = path.read_bytes()
    random = Random(f"11 {name}")
    assert READERS[name](path) is not None or name not in SPLATS
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(MUTANTS):
            if name in INSIDE:
                path.write_bytes(
                    gzip.compress(damaged(gzip.decompress(whole), random), 1)
                )
            else:
                path.write_bytes(damaged(whole, random))
            with contextlib.suppress(MiSplatError), limited():
                READERS[name](path)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", PACKED)
def test_truncation_at_each_length(name: str, tmp_path: Path) -> None:
    whole = valid(name)
    path = tmp_path / name
    lengths = sorted(
        {
            *range(0, len(whole), max(1, len(whole) // 80)),
            *range(min(60, len(whole))),
            len(whole) - 1,
        }
    )
    for length in lengths:
        path.write_bytes(whole[:length])
        scene = _splat(path)
        assert scene is None or (name == "a.splat" and 32 * len(scene) == length)
    path.write_bytes(whole + b"\0")
    # archives may have a comment, sections padding
    assert _splat(path) is None or name in ("a.sog", *PACKED[-3:])


DEEP = "[" * 100_000
LONG = "9" * 10_000
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
        (
            "cameras.json",
            lambda _: [
                {
                    "rotation": "x",
                    "position": {},
                    "fx": 1,
                    "fy": 1,
                    "width": 2,
                    "height": 2,
                }
            ],
        ),
        ("cameras.json", lambda values: {"views": [{"camera": 7}]}),
        (
            "cameras.json",
            lambda values: {"views": [{"camera": values[0]}], "cameras": 7},
        ),
        ("cameras.json", lambda values: {"reference": []}),
        ("transforms.json", put("frames", 0, "transform_matrix", value={"a": 1})),
        ("transforms.json", put("w", value="LONG")),
    ],
)
def test_broken_documents_are_refused_in_words(
    name: str, change: Callable[[Any], Any], tmp_path: Path
) -> None:
    path = made(name, tmp_path)
    text = json.dumps(change(json.loads(path.read_text())))
    path.write_text(text.replace('"DEEP"', DEEP).replace('"LONG"', LONG))
    with pytest.raises(MiSplatError, match=r": expected .*; \w"):
        READERS[name](path)


@pytest.mark.parametrize("name", ["cloak_demo.toml", "transfer.toml"])
@pytest.mark.parametrize(
    "text",
    [
        "x = " + "[" * 5000,
        "x." * 2000 + "y = 1",
        "seeds = " + "9" * 10_000,
        "\xff",
        "a = nan",
    ],
)
def test_broken_tables_are_refused_in_words(
    name: str, text: str, tmp_path: Path
) -> None:
    path = made(name, tmp_path)
    path.write_bytes(text.encode("latin-1") + b"\n" + path.read_bytes())
    with pytest.raises(MiSplatError, match=r": expected .*; \w"):
        READERS[name](path)
