"""Scene files of `splat_ray`: among meshes they are rendered as they are, alone they
are read as values.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from attacks.cli import main
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.picture_files import picture_header
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import (
    MixedScene,
    SplatScene,
    open_scene,
    read_scene,
    resized,
    write_scene,
)
from tests.fakes import camera, toy_scene
from tests.project.layers import ROOT

variant.use()

import mitsuba as mi  # noqa: E402

import mi_splat.render.plugins  # noqa: E402, F401

pytestmark = pytest.mark.shipped

MIXED = sorted((ROOT / "scenes" / "mixed").glob("*.xml"))


@pytest.mark.parametrize("path", MIXED, ids=lambda path: str(path.stem))
def test_every_mixed_scene_renders(path: Path) -> None:
    loaded = mi.load_file(str(path), size=24, samples=4)
    for number in range(len(loaded.sensors())):
        picture = np.array(mi.render(loaded, sensor=number))
        assert picture.shape == (24, 24, 3)
        assert np.isfinite(picture).all()
        assert 0.05 < picture.mean() < 2.0


def test_a_scene_of_splats_alone_is_read_with_its_integrator(tmp_path: Path) -> None:
    splat = ROOT / "scenes" / "car_street_car.ply"
    xml = (ROOT / "scenes" / "car_street.xml").read_text()
    xml = xml.replace(
        '<integrator type="splat_tile"/>',
        """<integrator type="splat_ray">
        <boolean name="linear" value="false"/>
          <boolean name="colour_to_mean" value="true"/></integrator>""",
    )
    xml = xml.replace("car_street_car.ply", str(splat)).replace(
        "car_street_street.ply", str(splat)
    )
    (tmp_path / "ray.xml").write_text(xml)
    loaded = read_scene(tmp_path / "ray.xml")
    assert (
        loaded.settings.method,
        loaded.settings.colour_to_mean,
        loaded.settings.linear,
    ) == ("ray", True, False)
    write_scene(loaded, loaded.scene, tmp_path / "again.xml")
    again = read_scene(tmp_path / "again.xml")
    assert (
        again.settings.method,
        again.settings.colour_to_mean,
        again.settings.linear,
    ) == ("ray", True, False)


def test_another_splat_stands_in_the_place_of_the_files() -> None:
    street = MixedScene(MIXED[0], samples=8)
    scene = street.splats.scene
    camera = resized(street.splats.cameras["side"], (40, 40))
    assert list(street.splats.objects) == ["car"]
    before = street(scene, camera)
    gone = street(replace(scene, opacities=torch.zeros_like(scene.opacities)), camera)
    changed = (before - gone).abs().mean(-1)
    assert changed[22, 20] > 0.1  # on the car
    # above it; noise is the same, but for paths that met the car
    assert changed[:8].mean() < 0.1 * changed.mean()
    # sums of a film are in any order
    torch.testing.assert_close(street(scene, camera), before, rtol=0, atol=1e-5)
    assert before.min() >= 0
    assert before.max() <= 1
    with pytest.raises(InvalidValueError, match="expected 10,075 Gaussians, got 10"):
        street(scene.select(torch.arange(10)), camera)


def test_the_command_renders_a_mixed_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "render",
        str(MIXED[0]),
        "--samples",
        "4",
        "--size",
        "24x20",
        "--out",
        str(tmp_path / "street.png"),
    ]
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["gaussians"] == 10075
    assert picture_header(tmp_path / "street.png")[0] == (24, 20)
    assert main([*words, "--method", "tile"]) != 0
    assert "leave it out" in capsys.readouterr().err


# A scene of parts that is written and read again is the same scene, and makes the same
# images


def scene_of(
    tmp_path: Path, *, names: tuple[str, str] = ("rest", "thing")
) -> SplatScene:
    """The toy scene, as a file holds its numbers."""
    scene, _ = toy_scene()
    save_splat(scene, tmp_path / "toy.ply")
    aside = Camera(
        to_world=look_at((1, -3, 0.5), (0, 0, 0)),
        lens=Lens(focal=30.0, size=(40, 24), principal=(18.0, 13.0)),
    )
    settings = RenderSettings(background=(0.2, 0.4, 0.6), near=0.05)
    parts = {names[0]: slice(0, 10), names[1]: slice(10, 40)}
    cameras = {"front": camera(), "aside": aside}
    return SplatScene(
        scene=load_splat(tmp_path / "toy.ply"),
        objects=parts,
        cameras=cameras,
        settings=settings,
    )


def test_a_scene_comes_back_as_it_was(tmp_path: Path, variant: str) -> None:
    loaded = scene_of(tmp_path)
    files = write_scene(loaded, loaded.scene, tmp_path / "new.xml")
    assert [file.name for file in files] == ["new_rest.ply", "new_thing.ply", "new.xml"]
    again = open_scene(tmp_path / "new.xml")
    assert again.objects == loaded.objects
    assert again.settings.near == pytest.approx(0.05)
    assert again.settings.background == pytest.approx((0.2, 0.4, 0.6))
    for before, after in zip(
        loaded.scene.tensors(), again.scene.tensors(), strict=True
    ):
        assert torch.allclose(before, after, atol=1e-6)
    for name, one in loaded.cameras.items():
        other = again.cameras[name]
        assert torch.allclose(one.to_world, other.to_world, atol=1e-6)
        assert (other.width, other.height) == (one.width, one.height)
        assert (other.fx, other.cx, other.cy) == pytest.approx(
            (one.fx, one.cx, one.cy), abs=1e-4
        )
        pictures = [
            Renderer(each.settings)(each.scene, each.cameras[name])
            for each in (loaded, again)
        ]
        assert float((pictures[0] - pictures[1]).abs().max()) < 1e-3


def test_names_that_no_file_can_have(tmp_path: Path, variant: str) -> None:
    loaded = scene_of(tmp_path, names=('a/"b"', "a:<b>"))
    files = write_scene(loaded, loaded.scene, tmp_path / "new.xml")
    assert len({file.name for file in files}) == 3
    assert {file.parent for file in files} == {tmp_path}
    assert list(open_scene(tmp_path / "new.xml").objects) == ['a/"b"', "a:<b>"]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: MixedScene(ROOT / "scenes" / "car_street.xml"), "splat_ray"),
        (lambda: MixedScene(MIXED[0], samples=0), "samples"),
        (lambda: read_scene(MIXED[0]), "splat_ray"),
    ],
)
def test_other_scenes_are_refused(call: Callable[[], object], words: str) -> None:
    with pytest.raises(InvalidValueError, match=words):
        call()


def test_what_a_scene_file_cannot_hold_is_refused(tmp_path: Path) -> None:
    loaded = scene_of(tmp_path)
    with pytest.raises(InvalidValueError, match="40 Gaussians, got 39"):
        write_scene(loaded, loaded.scene.select(slice(0, 39)), tmp_path / "new.xml")
    loaded.cameras["wide"] = Camera(
        to_world=torch.eye(4), lens=Lens(focal=(10.0, 20.0), size=(8, 8))
    )
    with pytest.raises(InvalidValueError, match="camera wide: expected square pixels"):
        write_scene(loaded, loaded.scene, tmp_path / "new.xml")
