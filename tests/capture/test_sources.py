"""What can be captured: shipped objects and scenes, mesh files, Mitsuba scenes; and
what cannot.
"""

from pathlib import Path

import pytest
from PIL import Image

from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.objects import object_file
from mi_splat.capture.settings import MeshSettings
from mi_splat.capture.sources import open_source
from mi_splat.errors import InvalidValueError, MiSplatError
from tests.capture.trucks import truck, write_glb

STILL_LIFE = Path(__file__).parents[2] / "scenes" / "meshes" / "still_life.xml"


XML = """<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/>
<shape type="cube"><bsdf type="diffuse">
  <rgb name="reflectance" value="0.8, 0.1, 0.1"/></bsdf></shape></scene>"""


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
    file = str(write_glb(tmp_path, truck()))
    settings = MeshSettings(scale=2.0, up="z")
    mesh = open_source(file, mesh=settings)
    assert mesh.assets[0].bounds == pytest.approx(
        2 * load_mesh(Path(file), MeshSettings(up="z")).bounds
    )
    assert mesh.digest == open_source(file, mesh=settings).digest
    assert mesh.digest != open_source(file, mesh=MeshSettings(scale=2.0)).digest
    with pytest.raises(InvalidValueError, match="radius"):
        open_source(file, mesh=MeshSettings(scale=1e3))


CUBE = """<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/>
<shape type="cube"><transform name="to_world"><translate x="{x}"/></transform>
  </shape></scene>"""


def test_a_mitsuba_scene_far_away_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "far.xml"
    path.write_text(CUBE.format(x=3))
    assert open_source(str(path)).centre[0] == pytest.approx(3)
    path.write_text(CUBE.format(x=400))
    with pytest.raises(MiSplatError, match=r"far\.xml.*subtract the middle"):
        open_source(str(path))


TEXTURED = """<scene version="3.0.0">
<integrator type="path"/><emitter type="constant"/>{before}
<shape type="cube"><bsdf type="diffuse">
  <texture type="bitmap" name="reflectance">{named}</texture></bsdf></shape>
</scene>"""
SPELLINGS = {
    "plain": ("", '<string name="filename" value="a.png"/>'),
    "a character by its number": ("", '<string name="filename" value="&#97;.png"/>'),
    "a default": (
        '<default name="t" value="a.png"/>',
        '<string name="filename" value="$t"/>',
    ),
    "a default that is included": (
        '<include filename="inner/b.xml"/>',
        '<string name="filename" value="$included"/>',
    ),
    "a folder of its own": (
        '<path value="inner"/>',
        '<string name="filename" value="c.png"/>',
    ),
}


def textured(folder: Path, before: str, named: str) -> str:
    """A scene of a cube whose texture is named in some way."""
    (folder / "inner").mkdir(exist_ok=True)
    (folder / "inner" / "b.xml").write_text(
        '<scene version="3.0.0"><default name="included" value="a.png"/></scene>'
    )
    (folder / "a.xml").write_text(TEXTURED.format(before=before, named=named))
    return str(folder / "a.xml")


def paint(folder: Path, red: int) -> None:
    """Write the textures, of as many bytes each time."""
    for path in (folder / "a.png", folder / "inner" / "c.png"):
        Image.new("RGB", (2, 2), (red, 0, 0)).save(path, format="BMP")


@pytest.mark.parametrize(("before", "named"), SPELLINGS.values(), ids=SPELLINGS)
def test_another_texture_is_another_scene_however_it_is_named(
    before: str, named: str, tmp_path: Path
) -> None:
    scene = textured(tmp_path, before, named)
    paint(tmp_path, 200)
    first = open_source(scene).digest
    assert open_source(scene).digest == first
    paint(tmp_path, 100)
    assert open_source(scene).digest != first


@pytest.mark.shipped
def test_a_shipped_object_is_the_mesh_file_that_it_is(tmp_path: Path) -> None:
    one, other, same = (open_source(name) for name in ("car", "tv", "car"))
    assert one.digest == same.digest != other.digest
    assert len(one.assets) == 1
    copy = tmp_path / "my_car.glb"
    copy.write_bytes(object_file("car").read_bytes())
    assert open_source(str(copy)).digest == one.digest
    with pytest.raises(InvalidValueError, match=r"scene: expected one of car_street"):
        open_source("car:3")
