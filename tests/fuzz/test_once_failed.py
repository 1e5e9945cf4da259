"""Files that were once answered by a traceback, made again by recipes: each is refused in words."""

import contextlib
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mi_splat.errors import MiSplatError
from tests.fuzz.campaign import mutated
from tests.fuzz.kinds import EVERY
from tests.fuzz.mutations import RAW, text_of

Change = Callable[[Any], Any]
"""From the JSON of a valid file to that of a broken one; what is None was changed in place."""


def put(*path: str | int, value: Any) -> Change:
    """Another value at a place."""

    def change(document: Any) -> Any:
        for key in path[:-1]:
            document = document[key]
        document[path[-1]] = value

    return change


def drop(*path: str | int) -> Change:
    """Nothing at a place."""

    def change(document: Any) -> Any:
        for key in path[:-1]:
            document = document[key]
        del document[path[-1]]

    return change


DEEP = f"{RAW}{'[' * 100_000}"
LONG = f"{RAW}{'9' * 10_000}"
CAMERA = "cameras cameras.json"

DOCUMENTS: list[tuple[str, Change]] = [
    (CAMERA, put(0, "to_world", value=DEEP)),
    (CAMERA, lambda values: [7]),
    (CAMERA, lambda values: [None]),
    (CAMERA, put(0, "focal", value=[[1], [2]])),
    (CAMERA, put(0, "size", value=[1e300, 4])),
    (CAMERA, put(0, "size", value=[LONG, 4])),
    (CAMERA, put(0, "name", value={})),
    (CAMERA, lambda values: [{"rotation": "x", "position": {}, "fx": 1, "fy": 1, "width": 2, "height": 2}]),
    (CAMERA, lambda values: {"views": [{"camera": 7}]}),
    (CAMERA, lambda values: {"views": [{"camera": values[0]}], "cameras": 7}),
    (CAMERA, lambda values: {"reference": []}),
    ("cameras transforms.json", put("frames", 0, "transform_matrix", value={"a": 1})),
    ("cameras transforms.json", put("w", value=LONG)),
    ("cameras transforms.json", put("world_offset", value=[f"{RAW}NaN", 0, 0])),
    ("record of a capture", put("inputs", value=7)),
    ("record of a capture", put("inputs", "scene", value=[])),
    ("record of a capture", put("format", value=f"{RAW}1e999")),
    ("record of a capture", drop("scene")),
    ("record of a capture", lambda values: {**values, "version": {}, "scene": "other", "inputs": {}}),
    ("training", put("view_queue", value=["x"])),
    ("training", put("history", value={})),
    ("training", put("config", value=[])),
    ("training", put("scene_extent", value=DEEP)),
    ("search", put("trace", value=[7])),
    ("search", put("price", value=[])),
    ("result dagger", put("views", value=7)),
    ("result dagger", put("views", value=DEEP)),
    ("result evaluate", put("detectors", value={})),
    ("result cloak", put("trigger_miss_rate", "total", value=1e300)),
    ("manifest.json", put("files", value=LONG)),
    ("mesh a.gltf", put("meshes", value=None)),
]


@pytest.mark.parametrize(("name", "change"), DOCUMENTS, ids=[f"{n} {kind}" for n, (kind, _) in enumerate(DOCUMENTS)])
def test_broken_documents_are_refused_in_words(name: str, change: Change, tmp_path: Path) -> None:
    kind = EVERY[name]
    assert kind.document is not None
    path = kind.make(tmp_path)
    kind.read(path)  # the whole one is read
    values = kind.document.get(path.read_bytes())
    changed = change(values)
    path.write_bytes(kind.document.put(path.read_bytes(), text_of(values if changed is None else changed)))
    with pytest.raises(MiSplatError, match=r": expected .*; \w"):
        kind.read(path)


@pytest.mark.parametrize("name", ["study", "study of attacks"])
@pytest.mark.parametrize(
    "text", ["x = " + "[" * 5000, "x." * 2000 + "y = 1", "seeds = " + "9" * 10_000, "\xff", "a = nan"]
)
def test_broken_tables_are_refused_in_words(name: str, text: str, tmp_path: Path) -> None:
    path = EVERY[name].make(tmp_path)
    path.write_bytes(text.encode("latin-1") + b"\n" + path.read_bytes())
    with pytest.raises(MiSplatError, match=r": expected .*; \w"):
        EVERY[name].read(path)


@pytest.mark.parametrize(("name", "number"), [("weights w.pth", 1625), ("record of a capture", 1376)])
def test_mutants_of_the_campaign_are_read_or_refused(name: str, number: int, tmp_path: Path) -> None:
    path = EVERY[name].make(tmp_path)
    path.write_bytes(mutated(name, number, path.read_bytes()))
    with contextlib.suppress(MiSplatError):
        EVERY[name].read(path)


# Every kind of file, damaged by chance: a value or an error of this project, in bounded time and memory


SECONDS = 3.0
"""For each kind; about five minutes in all."""
GROUPS = list(dict.fromkeys(name.split()[0] for name in EVERY))


@pytest.mark.nightly
@pytest.mark.parametrize("group", GROUPS)
def test_damaged_files_are_read_or_refused_in_words(group: str) -> None:
    names = [name for name in EVERY if name.split()[0] == group]
    words = [sys.executable, "-m", "tests.fuzz.campaign", str(SECONDS), *names]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60 + 20 * SECONDS * len(names))
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert not [line for line in lines if "raised" in line]
    assert done.returncode == 0, done.stderr[-2000:]
    assert [line["kind"] for line in lines if line["mutants"]] == names
