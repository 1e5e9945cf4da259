"""Two independent programs decode our files to the same scenes, and we theirs.

gaussforge comes from PyPI with the extra `dev`. splat-transform comes from npm (tried
with 2.7.1):

    npm install --prefix FOLDER @playcanvas/splat-transform@2.7.1
    export SPLAT_TRANSFORM=FOLDER/node_modules/.bin/splat-transform
    python -m pytest tests/io/test_other_programs.py

Without the variable it is looked for on the path. What is not there is skipped. Each
program writes a plain PLY of what it has decoded; the scenes have no symmetry, so that
an axis, a sign or an order that differs shows.
"""

import importlib
import importlib.util
import os
import shutil
import subprocess
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest
import torch

from mi_splat.io import load_splat, save_splat
from mi_splat.io.formats import axes
from mi_splat.io.loaded import arrays_of, as_scene
from mi_splat.io.splat_files import write_splat_file
from mi_splat.maths.rotation import normalise, to_matrix
from mi_splat.scene import GaussianScene, Similarity
from tests.io.format_files import assert_close, tame_scene

BINARY = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
TURN = to_matrix(normalise(torch.tensor([0.8, -0.4, 0.3, 0.5], dtype=torch.float64)))
Decode = Callable[[Path, Path], GaussianScene]


def transform(*words: str | Path) -> None:
    """Run splat-transform."""
    if BINARY is None:
        pytest.skip("splat-transform is not there; the docstring says how to get it")
    command = [BINARY, "-q", "-w", "-g", "cpu", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def forge() -> Any:
    """The converter of gaussforge."""
    if importlib.util.find_spec("gaussforge") is None:
        pytest.skip("gaussforge is not there: pip install gaussforge")
    return importlib.import_module("gaussforge").GaussForge()


def by_transform(path: Path, folder: Path) -> GaussianScene:
    """What splat-transform decodes."""
    transform(path, folder / "decoded.ply")
    return load_splat(folder / "decoded.ply")


def by_forge(path: Path, folder: Path) -> GaussianScene:
    """What gaussforge decodes."""
    converted = forge().convert(path.read_bytes(), path.name.split(".", 1)[1], "ply")
    assert "error" not in converted, converted
    (folder / "decoded.ply").write_bytes(converted["data"])
    scene = load_splat(folder / "decoded.ply")
    # It leaves the axes of SPZ (y up) as they are, where splat-transform and we turn to
    # those of the PLY (y down).
    if path.suffix == ".spz":
        return as_scene(axes.flipped(arrays_of(scene), axes.X))
    return scene


def decoded_alike(
    path: Path, folder: Path, decode: Decode, **tolerances: float
) -> GaussianScene:
    """What we decode, after a check that another program decodes the same."""
    ours = load_splat(path)
    assert_close(ours, decode(path, folder), **tolerances)
    return ours


WRITTEN: list[tuple[str, Literal[2, 3, 4]]] = [
    *((suffix, 3) for suffix in ("compressed.ply", "splat", "sog", "spz")),
    ("spz", 2),
    ("spz", 4),
]
SLACK = {"splat": {"rotations": 0.95}}
"""They read bytes of a quaternion as b / 127.5 - 1, the viewer that the format comes
from as (b - 128) / 128.
"""


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize(("suffix", "version"), WRITTEN)
@pytest.mark.parametrize("decode", [by_transform, by_forge])
def test_they_read_what_we_write(
    decode: Decode, suffix: str, version: Literal[2, 3, 4], degree: int, tmp_path: Path
) -> None:
    path = tmp_path / f"ours.{suffix}"
    asked = version if suffix == "spz" else None
    write_splat_file(tame_scene(300, degree), path, version=asked)
    decoded_alike(path, tmp_path, decode, **SLACK.get(suffix, {}))


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize(
    "words",
    [["a.compressed.ply"], ["a.sog"], ["--spz-version", "3", "a.spz"], ["a.spz"]],
)
def test_we_read_what_splat_transform_writes(
    words: list[str], degree: int, tmp_path: Path
) -> None:
    save_splat(tame_scene(300, degree), tmp_path / "in.ply")
    *options, name = words
    transform(*options, tmp_path / "in.ply", tmp_path / name)
    decoded_alike(tmp_path / name, tmp_path, by_transform)


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("decode", [by_transform, by_forge])
@pytest.mark.parametrize("suffix", ["compressed.ply", "splat", "sog", "spz"])
def test_we_read_what_gaussforge_writes(
    suffix: str, decode: Decode, degree: int, tmp_path: Path
) -> None:
    save_splat(tame_scene(300, degree), tmp_path / "in.ply")
    written = forge().convert((tmp_path / "in.ply").read_bytes(), "ply", suffix)
    assert "error" not in written, written
    path = tmp_path / f"theirs.{suffix}"
    path.write_bytes(written["data"])
    decoded_alike(path, tmp_path, decode, **SLACK.get(suffix, {}))


@pytest.mark.parametrize("degree", [0, 3])
def test_gltf_of_splat_transform(degree: int, tmp_path: Path) -> None:
    """It writes glTF and does not read it: its file and ours have to load as the scene
    from which they were made.
    """
    scene = tame_scene(300, degree)
    save_splat(scene, tmp_path / "in.ply")
    transform(tmp_path / "in.ply", tmp_path / "theirs.glb")
    save_splat(scene, tmp_path / "ours.glb")
    for name in ("theirs.glb", "ours.glb"):
        assert_close(load_splat(tmp_path / name), scene)


@pytest.mark.parametrize("suffix", ["compressed.ply", "sog", "spz"])
@pytest.mark.parametrize("decode", [by_transform, by_forge])
def test_converting_what_was_turned_is_turning_what_was_converted(
    decode: Decode, suffix: str, tmp_path: Path
) -> None:
    """Under a rotation, all values change, SH of all bands too; what the other program
    decodes turns with us.
    """
    scene = tame_scene(200, 3)
    scene = scene.replace(sh=torch.cat([scene.sh[:, :1], scene.sh[:, 1:] * 0.3], dim=1))
    move = Similarity(
        rotation=TURN, translation=torch.tensor([0.1, 2.0, -1.0]), scale=0.7
    )
    order = {}
    for name, source in (("plain", scene), ("turned", scene.transform(move))):
        path = tmp_path / f"{name}.{suffix}"
        order[name] = write_splat_file(source, path).order
        decoded = decode(path, tmp_path)
        if order[name] is not None:
            decoded = decoded.select(torch.from_numpy(order[name]).argsort())
        if name == "plain":
            before = decoded
    assert_close(
        before.transform(move),
        decoded,
        means=0.01,
        scales=0.08,
        rotations=2.5,
        opacities=0.003,
        colours=0.02,
        sh=0.07,
    )


def test_trimesh_draws_our_gltf_as_points(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = tame_scene(50, 1)
    save_splat(scene, tmp_path / "a.glb")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        (cloud,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    expected = scene.means * torch.tensor([-1.0, -1.0, 1.0])
    torch.testing.assert_close(
        torch.from_numpy(cloud.vertices.copy()).float(), expected
    )
