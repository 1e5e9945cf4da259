"""Meshes of any size, and far from their origin: the same pictures, and coordinates that lose nothing."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from attacks import cli
from mi_splat.cameras import Camera
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.sources import open_source
from mi_splat.datasets import load_dataset
from mi_splat.errors import MiSplatError
from mi_splat.metrics import psnr
from tests.capture.trucks import truck, write_glb

pytest.importorskip("trimesh")

UTM = (500_000.0, 4_500_000.0, 100.0)


@dataclass(frozen=True, kw_only=True)
class Captured:
    """A set of the truck."""

    pictures: Tensor
    points: Tensor
    cameras: tuple[Camera, ...]
    document: dict[str, object]


def captured(path: Path, out: Path, *more: str) -> Captured:
    words = ["--cameras", "hemisphere:4", "--size", "40", "--samples", "16", "--points", "300", "--ground", "road"]
    assert cli.main(["capture", str(path), "--out", str(out), *words, *more]) == 0
    dataset = load_dataset(out)
    assert dataset.points is not None
    document = json.loads((out / "transforms_train.json").read_text())
    pictures = torch.stack([view.image for view in dataset])
    return Captured(pictures=pictures, points=dataset.points.points, cameras=tuple(dataset.cameras), document=document)


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    folder = tmp_path_factory.mktemp("usual")
    return captured(write_glb(folder, truck()), folder / "out")


def assert_in_proportion(scaled: Captured, usual: Captured, *, size: float) -> None:
    """The same pictures, from cameras and with points that are `size` times as far from the origin."""
    assert psnr(scaled.pictures, usual.pictures) > 60
    assert torch.allclose(scaled.points.amin(0) / size, usual.points.amin(0), atol=0.05)
    assert torch.allclose(scaled.points.amax(0) / size, usual.points.amax(0), atol=0.05)
    for ours, theirs in zip(scaled.cameras, usual.cameras, strict=True):
        assert torch.allclose(ours.position / size, theirs.position, atol=1e-3)


@pytest.mark.parametrize(
    ("factor", "scale"), [(100.0, 0.01), (1000.0, 1.0), (0.0005, 1.0)], ids=["centimetres", "5 km", "2.5 mm"]
)
def test_size_changes_no_picture(factor: float, scale: float, usual: Captured, tmp_path: Path) -> None:
    dataset = captured(write_glb(tmp_path, truck().placed(scale=factor)), tmp_path / "out", "--scale", str(scale))
    assert_in_proportion(dataset, usual, size=factor * scale)
    assert "world_offset" not in dataset.document


def test_a_mesh_far_away_is_brought_to_the_origin(
    usual: Captured, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_glb(tmp_path, truck(), node={"translation": [UTM[0], UTM[2], -UTM[1]]})
    dataset = captured(path, tmp_path / "out")
    assert psnr(dataset.pictures, usual.pictures) > 60
    middle = (truck().vertices.min(0) + truck().vertices.max(0)) / 2 + UTM
    offset = dataset.document["world_offset"]
    assert np.allclose(np.array(offset), middle, atol=1e-6)
    record = json.loads((tmp_path / "out" / "capture.json").read_text())
    assert record["world_offset"] == offset
    out = capsys.readouterr().out
    assert f"{middle[0]:.10g}" in out
    assert "far from its origin" in out
    assert float(dataset.points.abs().max()) < 20
    # The cameras of such a set are those of the same place.
    again = captured(path, tmp_path / "again", "--cameras", str(tmp_path / "out" / "transforms_train.json"))
    assert torch.equal(again.pictures, dataset.pictures)


def test_a_file_too_coarse_for_its_place_is_warned_of(tmp_path: Path) -> None:
    (warning,) = load_mesh(write_glb(tmp_path, truck().placed(move=UTM))).warnings
    assert "coordinates up to 45000" in warning
    assert "in steps of 0.5 (float32)" in warning
    assert load_mesh(write_glb(tmp_path, truck().placed(move=(500, 0, 0)))).warnings == ()


CUBE = """<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/>
<shape type="cube"><transform name="to_world"><translate x="{x}"/></transform></shape></scene>"""


def test_a_mitsuba_scene_far_away_is_warned_of_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "far.xml"
    warnings = {}
    for x in (3, 400, 100_000):
        path.write_text(CUBE.format(x=x))
        if x < 1000:
            warnings[x] = open_source(str(path)).warnings
    assert warnings[3] == ()
    assert "subtract the middle" in warnings[400][0]
    with pytest.raises(MiSplatError, match=r"far\.xml.*subtract the middle"):
        open_source(str(path))
