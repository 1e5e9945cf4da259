"""Damage that was once answered by a traceback; each is refused in words."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mi_splat.errors import MiSplatError
from tests.campaign.kinds import KINDS
from tests.io.test_damaged_files import put


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("world transforms.json", put("applied_transform", value=[[0, 0, 0, 0]] * 3)),
        ("world transforms.json", put("applied_scale", value=0)),
        ("cameras keyframes.json", put("keyframes", 0, "matrix", value="[" * 9000)),
        ("cameras keyframes.json", put("keyframes", 0, "aspect", value=1.7e308)),
    ],
)
def test_documents(name: str, change: Callable[[Any], Any], tmp_path: Path) -> None:
    kind = KINDS[name]
    path = kind.make(tmp_path)
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    with pytest.raises(MiSplatError, match=r": expected .*; \w"):
        kind.read(path)


@pytest.mark.parametrize("number", [0, 1e200, 1.7e308])
def test_rotations_that_are_none_say_nothing_of_up(
    number: float, tmp_path: Path
) -> None:
    kind = KINDS["cameras beside a splat"]
    path = kind.make(tmp_path)
    cameras = json.loads(path.read_text())
    path.write_text(
        json.dumps([*cameras, {**cameras[0], "rotation": [[number] * 3] * 3}])
    )
    assert "cameras" not in str(kind.read(path))


@pytest.mark.parametrize(
    ("name", "data"),
    [("mesh.ply", b"ply\n\xff\n"), ("mesh.obj", b"v 0 0 0\nf \xb0 1 2\n")],
)
def test_meshes_that_are_no_text(name: str, data: bytes, tmp_path: Path) -> None:
    kind = KINDS[f"mesh scene {name}"]
    path = kind.make(tmp_path)
    path.write_bytes(data)
    with pytest.raises(MiSplatError, match=r": expected .*; \w"):
        kind.read(path)


def test_messages_name_members_of_any_length(tmp_path: Path) -> None:
    error = MiSplatError.of(
        "a.sog", f"a member {'long' * 5000}", "none", f"look at {'x' * 9000}"
    )
    assert len(str(error)) < 4000
