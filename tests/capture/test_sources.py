"""What can be captured: recipes, assets by name and seed, mesh files, Mitsuba scenes; and what cannot."""

from __future__ import annotations

from pathlib import Path

import pytest

from mi_splat.capture.settings import MeshSettings, SurroundingsSettings
from mi_splat.capture.sources import open_source
from mi_splat.errors import InvalidValueError, MiSplatError

STILL_LIFE = Path(__file__).parents[2] / "scenes" / "meshes" / "still_life.xml"


XML = """<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/>
<shape type="cube"><bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.1, 0.1"/></bsdf></shape></scene>"""


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_sources_of_every_kind(tmp_path: Path) -> None:
    car = open_source("car_street")
    assert len(car.assets) == 2
    assert 2 < car.radius < 4
    still = open_source(str(STILL_LIFE))
    assert still.assets == ()
    assert still.centre == pytest.approx((0, 0, 0.6), abs=1e-3)
    (tmp_path / "cube.xml").write_text(XML)
    cube = open_source(str(tmp_path / "cube.xml"))
    assert cube.radius == pytest.approx(3**0.5, abs=1e-3)
    (tmp_path / "cube.xml").write_text(XML.replace("0.8", "0.7"))
    assert open_source(str(tmp_path / "cube.xml")).digest != cube.digest
    pytest.importorskip("trimesh")
    (tmp_path / "mesh.obj").write_text(OBJ)
    mesh = open_source(str(tmp_path / "mesh.obj"), mesh=MeshSettings(scale=2.0, up="z"))
    assert mesh.assets[0].bounds.tolist() == [[0, 0, 0], [2, 2, 2]]
    assert mesh.digest == open_source(str(tmp_path / "mesh.obj"), mesh=MeshSettings(scale=2.0, up="z")).digest
    assert mesh.digest != open_source(str(tmp_path / "mesh.obj"), mesh=MeshSettings(scale=2.0)).digest
    with pytest.raises(InvalidValueError, match="radius"):
        open_source(str(tmp_path / "mesh.obj"), mesh=MeshSettings(scale=1e9))


def test_scenes_that_mitsuba_cannot_load_are_named(tmp_path: Path) -> None:
    (tmp_path / "bad.xml").write_text("<scene")
    with pytest.raises(MiSplatError, match=r"bad\.xml: expected a Mitsuba XML file"):
        open_source(str(tmp_path / "bad.xml"))


def test_a_scene_of_splats_is_called_so() -> None:
    with pytest.raises(InvalidValueError, match=r"car_street\.xml: expected a scene of meshes.*mi-splat render"):
        open_source(str(STILL_LIFE.parents[1] / "car_street.xml"))


def test_an_asset_by_name_and_seed_is_a_source() -> None:
    one, other, same = (open_source(name) for name in ("car:3", "car:4", "car:3"))
    assert one.digest == same.digest != other.digest
    assert len(one.assets) == 1
    with pytest.raises(InvalidValueError, match="change the seed"):
        open_source("car:three")
    with pytest.raises(InvalidValueError, match="0 to 999999999, got car:;"):
        open_source("car:")


def test_an_object_of_the_project_can_stand_on_the_ground() -> None:
    alone = open_source("car:3")
    (car, ground) = open_source("car:3", surroundings=SurroundingsSettings(ground="road")).assets
    assert ground.bounds[:, 2].tolist() == [car.bounds[0, 2]] * 2
    side = float(ground.bounds[1, 0] - ground.bounds[0, 0])
    assert side == pytest.approx(6.5 * alone.radius, rel=1e-5)
    assert (ground.bounds.mean(0)[:2]).tolist() == pytest.approx(alone.centre[:2], abs=1e-5)
    with pytest.raises(InvalidValueError, match="ground, sun and environment"):
        open_source("car_street", surroundings=SurroundingsSettings(ground="road"))
