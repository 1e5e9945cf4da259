"""A scene of parts that is written and read again is the same scene, and makes the same pictures."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from mi_splat.cameras import Camera, look_at
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene_files import SplatScene, open_scene
from mi_splat.scene_writing import write_scene
from tests.fakes import camera, toy_scene


def scene_of(tmp_path: Path, *, names: tuple[str, str] = ("rest", "thing")) -> SplatScene:
    """The toy scene, as a file holds its numbers."""
    scene, _ = toy_scene()
    save_splat(scene, tmp_path / "toy.ply")
    aside = Camera(to_world=look_at((1, -3, 0.5), (0, 0, 0)), focal=30.0, width=40, height=24, principal=(18.0, 13.0))
    settings = RenderSettings(background=(0.2, 0.4, 0.6), near=0.05)
    parts = {names[0]: slice(0, 10), names[1]: slice(10, 40)}
    cameras = {"front": camera(), "aside": aside}
    return SplatScene(scene=load_splat(tmp_path / "toy.ply"), objects=parts, cameras=cameras, settings=settings)


def test_a_scene_comes_back_as_it_was(tmp_path: Path, variant: str) -> None:
    loaded = scene_of(tmp_path)
    files = write_scene(loaded, loaded.scene, tmp_path / "new.xml")
    assert [file.name for file in files] == ["new_rest.ply", "new_thing.ply", "new.xml"]
    again = open_scene(tmp_path / "new.xml")
    assert again.objects == loaded.objects
    assert again.settings.near == pytest.approx(0.05)
    assert again.settings.background == pytest.approx((0.2, 0.4, 0.6))
    for before, after in zip(loaded.scene.tensors(), again.scene.tensors(), strict=True):
        assert torch.allclose(before, after, atol=1e-6)
    for name, one in loaded.cameras.items():
        other = again.cameras[name]
        assert torch.allclose(one.to_world, other.to_world, atol=1e-6)
        assert (other.width, other.height) == (one.width, one.height)
        assert (other.fx, other.cx, other.cy) == pytest.approx((one.fx, one.cx, one.cy), abs=1e-4)
        pictures = [Renderer(each.settings)(each.scene, each.cameras[name]) for each in (loaded, again)]
        assert float((pictures[0] - pictures[1]).abs().max()) < 1e-3


def test_names_that_no_file_can_have(tmp_path: Path, variant: str) -> None:
    loaded = scene_of(tmp_path, names=('a/"b"', "a:<b>"))
    files = write_scene(loaded, loaded.scene, tmp_path / "new.xml")
    assert len({file.name for file in files}) == 3
    assert {file.parent for file in files} == {tmp_path}
    assert list(open_scene(tmp_path / "new.xml").objects) == ['a/"b"', "a:<b>"]


def test_another_scene_is_refused(tmp_path: Path) -> None:
    loaded = scene_of(tmp_path)
    with pytest.raises(InvalidValueError, match="40 Gaussians, got 39"):
        write_scene(loaded, loaded.scene.select(slice(0, 39)), tmp_path / "new.xml")
    assert not (tmp_path / "new.xml").exists()


def test_pixels_that_are_not_square_are_refused(tmp_path: Path) -> None:
    loaded = scene_of(tmp_path)
    loaded.cameras["wide"] = Camera(to_world=torch.eye(4), focal=(10.0, 20.0), width=8, height=8)
    with pytest.raises(InvalidValueError, match="camera wide: expected square pixels"):
        write_scene(loaded, loaded.scene, tmp_path / "new.xml")
