"""Scene files of unknown origin: what would end the process or fill the memory is
refused before Mitsuba reads it.
"""

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from attacks import cli
from mi_splat.capture.path_tracer import load_scene, tracing_variant
from mi_splat.capture.sources import open_source
from mi_splat.errors import MiSplatError
from mi_splat.io.picture_files import pixel_limit
from mi_splat.io.scene_parts import DEEPEST, MOST_BYTES, MOST_ELEMENTS, SceneParts
from mi_splat.render.scene_files import MixedScene, holds_surfaces, read_scene
from tests.project.layers import ROOT

pytestmark = pytest.mark.shipped


def scene(*inside: str) -> bytes:
    return "".join(['<scene version="3.0.0">', *inside, "</scene>"]).encode()


def nested(depth: int) -> bytes:
    return scene('<shape type="sphere">' * depth, "</shape>" * depth)


ENTITIES = (
    '<!DOCTYPE scene [<!ENTITY a "aa">'
    + "".join(f'<!ENTITY b{i} "&a;&a;">' for i in range(9))
    + "]>"
)
DOUBLED = '<default name="p{}" value="$p{}$p{}"/>'
REFUSED: dict[str, tuple[Callable[[], bytes], str]] = {
    "8,000 in each other": (
        lambda: nested(8000),
        f"more than {DEEPEST} elements in each other",
    ),
    "many": (
        lambda: scene('<shape type="sphere"/>' * MOST_ELEMENTS),
        "more than 100,000 elements",
    ),
    "large": (lambda: scene(" " * MOST_BYTES), "bytes, more than"),
    "entities": (lambda: ENTITIES.encode() + scene("&b8;"), "DOCTYPE"),
    "files as entities": (
        lambda: b'<!DOCTYPE s [<!ENTITY a SYSTEM "/etc/hostname">]>' + scene("&a;"),
        "DOCTYPE",
    ),
    "no UTF-8": (
        lambda: scene('<shape type="sphere" id="x"/>').replace(b"x", b"\xe4\xff"),
        "utf-8",
    ),
    "Latin-1": (
        lambda: b'<?xml version="1.0" encoding="latin1"?>' + scene(),
        "encoding latin1",
    ),
    "itself": (lambda: scene('<include filename="a.xml"/>'), r"a\.xml includes a\.xml"),
    "itself by a default": (
        lambda: scene('<default name="f" value="a"/><include filename="$f.xml"/>'),
        r"a\.xml includes a\.xml",
    ),
    "a circle": (
        lambda: scene('<include filename="b/b.xml"/>'),
        r"a\.xml includes b\.xml includes a\.xml",
    ),
    "one in a path": (
        lambda: scene('<path value="b"/><include filename="c.xml"/>'),
        r"c\.xml.*not well-formed",
    ),
    "parameters of parameters": (
        lambda: scene(
            '<default name="p0" value="x"/>',
            *map(DOUBLED.format, range(1, 40), range(39), range(39)),
        ),
        "at most 16,777,216 characters",
    ),
    "a long parameter": (
        lambda: scene(
            f'<default name="p" value="{"x" * 100_000}"/>',
            f'<string name="{"$p" * 10_000}" value=""/>',
        ),
        "at most 16,777,216 characters",
    ),
    "a plugin of its own": (
        lambda: scene('<bsdf type="evil"/>'),
        'type="evil" in <bsdf>',
    ),
    "a plugin by its path": (
        lambda: scene('<emitter type="../evil"/>'),
        r'type="\.\./evil" in <emitter>',
    ),
    "a plugin by a default": (
        lambda: scene(
            '<default name="t" value="evil"/>',
            '<shape type="sphere"><bsdf type="$t"/></shape>',
        ),
        'type="evil"',
    ),
    "a plugin in an included file": (
        lambda: scene('<include filename="b/d.xml"/>'),
        'type="evil" in <texture>',
    ),
    "code with the name of a plugin": (
        lambda: scene('<path value="b"/>'),
        r"no native code next to it, got .*diffuse",
    ),
    "a device": (
        lambda: scene('<string name="filename" value="/dev/zero"/>'),
        "/dev/zero, a device or a pipe",
    ),
    "a pipe": (
        lambda: scene('<spectrum name="s" filename="b/pipe"/>'),
        "b/pipe, a device or a pipe",
    ),
    "a pipe that is included": (
        lambda: scene('<include filename="b/pipe"/>'),
        "b/pipe, a device or a pipe",
    ),
    "a tree of many": (
        lambda: scene('<include filename="t4.xml"/>' * 50),
        "at most 1,000 inclusions",
    ),
}


def serialized(
    vertices: int, *, faces: int = 1, zeros: int = 0, count: int = 1
) -> bytes:
    """A mesh in Mitsuba's own format: compressed, with a table of where each mesh
    begins.
    """
    head = struct.pack("<I", 0x1000) + b"m\0" + struct.pack("<QQ", vertices, faces)
    data = zlib.compress(head + bytes(zeros), 9)
    return (
        struct.pack("<HH", 0x041C, 4)
        + data
        + struct.pack(f"<{count}Q", *[0] * count)
        + struct.pack("<I", count)
    )


def shape(kind: str, name: str) -> str:
    return f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>'


PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float"
    b" x\nend_header\n"
)
SIZES: dict[str, tuple[str, bytes, str]] = {
    "a bomb": (
        shape("serialized", "m.bin"),
        serialized(150_000_000, zeros=1 << 20),
        "at most 2,000,000,000 bytes in all",
    ),
    "many faces": (
        shape("serialized", "m.bin"),
        serialized(3, faces=1 << 60),
        "at most 2,000,000,000 bytes in all",
    ),
    "many in one": (
        shape("serialized", "m.bin"),
        serialized(9_000_000, count=9),
        "at most 2,000,000,000 bytes in all",
    ),
    "many times": (
        shape("serialized", "m.bin") * 9,
        serialized(9_000_000),
        "at most 2,000,000,000 bytes in all",
    ),
    "cut off": (
        shape("serialized", "m.bin"),
        b"\x1c\x04\4",
        "expected a serialized mesh, got a file that is cut off",
    ),
    "no counts": (
        shape("serialized", "m.bin"),
        serialized(3)[:12] + bytes(20),
        "expected a serialized mesh",
    ),
    "a table that lies": (
        shape("serialized", "m.bin"),
        serialized(3)[:-4] + b"\xff" * 4,
        "4,294,967,295 meshes",
    ),
    "a PLY that lies": (shape("ply", "m.bin"), PLY, "hold, got 4,000,000,000 elements"),
    "a volume that lies": (
        '<volume type="gridvolume"><string name="filename" value="m.bin"/></volume>',
        b"VOL\3" + struct.pack("<i4i6f", 1, 1 << 10, 1 << 10, 1 << 10, 3, *[0.0] * 6),
        "hold, got 3,221,225,472 values",
    ),
}


@pytest.mark.parametrize("case", SIZES)
def test_what_a_mesh_or_a_volume_states_is_bounded_before_it_is_read(
    case: str, tmp_path: Path
) -> None:
    inside, data, message = SIZES[case]
    (tmp_path / "m.bin").write_bytes(data)
    (tmp_path / "s.xml").write_bytes(scene(inside))
    with pytest.raises(MiSplatError, match=message):
        SceneParts(tmp_path / "s.xml").check()


def test_a_sparse_file_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "m.obj").open("wb") as file:
        file.truncate(1 << 40)
    (tmp_path / "s.xml").write_bytes(scene(shape("obj", "m.obj")))
    with pytest.raises(MiSplatError, match="bytes in all"):
        SceneParts(tmp_path / "s.xml").check()


def test_a_small_serialized_mesh_may_be_read(tmp_path: Path) -> None:
    (tmp_path / "m.bin").write_bytes(serialized(3, zeros=200))
    (tmp_path / "s.xml").write_bytes(scene(shape("serialized", "m.bin")))
    SceneParts(tmp_path / "s.xml").check()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "b.xml").write_bytes(scene('<include filename="../a.xml"/>'))
    (tmp_path / "b" / "c.xml").write_bytes(b"\1")
    (tmp_path / "b" / "d.xml").write_bytes(scene('<texture type="evil"/>'))
    (tmp_path / "b" / "plugins").mkdir()
    (tmp_path / "b" / "plugins" / "diffuse.so").write_bytes(b"")
    os.mkfifo(tmp_path / "b" / "pipe")
    (tmp_path / "t0.xml").write_bytes(scene('<shape type="sphere"/>'))
    for number in range(4):
        (tmp_path / f"t{number + 1}.xml").write_bytes(
            scene(f'<include filename="t{number}.xml"/>' * 50)
        )
    return tmp_path


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_scene_needs_is_refused(name: str, folder: Path) -> None:
    make, says = REFUSED[name]
    path = folder / "a.xml"
    path.write_bytes(make())
    with pytest.raises(MiSplatError, match=says):
        SceneParts(path).check()


@pytest.mark.parametrize(
    "name", ["8,000 in each other", "a circle", "a plugin of its own", "a device"]
)
def test_every_reader_checks_first(name: str, folder: Path) -> None:
    make, says = REFUSED[name]
    path = folder / "a.xml"
    path.write_bytes(make())
    for read in (
        read_scene,
        MixedScene,
        load_scene,
        lambda path: open_source(str(path)),
    ):
        with pytest.raises(MiSplatError, match=says):
            read(path)
    assert not holds_surfaces(path)


def test_commands_say_it_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    Path("a.xml").write_bytes(nested(8000))
    for words in (
        "render a.xml",
        "info a.xml",
        "capture a.xml --out out",
        "select a.xml",
        "detect a.xml --out out",
    ):
        assert cli.main(words.split()) == 1
        assert "in each other" in capsys.readouterr().err
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("file", "given", "written"),
    [
        ("wood.png", "", "wood.png"),
        ("wood.dat", "", "wood.dat"),  # Mitsuba knows images by their first bytes
        ("wood", "", "wood"),
        # as Mitsuba reads parameters
        ("woodbar.png", '<default name="foo" value="wood"/>', "$foobar.png"),
        (
            "oakbar.png",
            '<default name="f" value="x"/><default name="foo" value="oak"/>',
            "$foobar.png",
        ),
    ],
)
def test_pictures_that_a_scene_names_are_counted(
    file: str, given: str, written: str, tmp_path: Path
) -> None:
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(tmp_path / file, format="PNG")
    texture = (
        '<texture type="bitmap" name="reflectance"><string name="filename"'
        f' value="{written}"/></texture>'
    )
    path = tmp_path / "a.xml"
    path.write_bytes(
        scene(
            f'{given}<shape type="sphere"><bsdf type="diffuse">{texture}</bsdf></shape>'
        )
    )
    with pixel_limit(1200):
        assert open_source(str(path)).radius > 0
    with (
        pixel_limit(1199),
        pytest.raises(MiSplatError, match=rf"{file}: expected at most 1,199 pixels"),
    ):
        open_source(str(path))


def test_an_inclusion_behind_a_parameter_is_read_as_mitsuba_reads_it(
    tmp_path: Path,
) -> None:
    (tmp_path / "deepinc.xml").write_bytes(nested(200))
    path = tmp_path / "a.xml"
    path.write_bytes(
        scene('<default name="foo" value="deep"/><include filename="$fooinc.xml"/>')
    )
    with pytest.raises(MiSplatError, match="in each other"):
        open_source(str(path))


def test_an_inclusion_is_first_looked_for_beside_the_file_that_includes_it(
    tmp_path: Path,
) -> None:
    for folder in ("b", "c"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "leaf.xml").write_bytes(
            scene(f'<shape type="sphere" id="{folder}"/>')
        )
    (tmp_path / "b" / "inner.xml").write_bytes(scene('<include filename="leaf.xml"/>'))
    (tmp_path / "a.xml").write_bytes(
        scene('<path value="c"/><include filename="b/inner.xml"/>')
    )
    assert SceneParts(tmp_path / "a.xml").files[1:] == [
        tmp_path / "b" / "inner.xml",
        tmp_path / "b" / "leaf.xml",
    ]
    with tracing_variant():  # as Mitsuba does
        assert [shape.id() for shape in load_scene(tmp_path / "a.xml").shapes()] == [
            "b"
        ]


def test_the_files_of_a_scene_are_all_that_it_names(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    for name in ("parts/a.ply", "parts/b.spd", "beside.ply"):
        (tmp_path / name).write_text("400 1")
    (tmp_path / "b.xml").write_bytes(
        scene('<spectrum name="s" filename="parts/b.spd"/>')
    )
    named = ("$folder/a.ply", "not there.ply", "", "long" * 100)
    texts = (f'<string name="f" value="{name}"/>' for name in named)
    path = tmp_path / "a.xml"
    path.write_bytes(
        scene(
            '<default name="folder" value="parts"/>',
            *texts,
            '<include filename="b.xml"/>',
        )
    )
    assert SceneParts(path).files == [
        path,
        *(tmp_path / name for name in ("parts/a.ply", "b.xml", "parts/b.spd")),
    ]
    os.mkfifo(tmp_path / "pipe.xml")
    for wrong in ("none.xml", "beside.ply", "pipe.xml"):
        with pytest.raises(MiSplatError, match=f"{wrong}: expected a Mitsuba XML file"):
            SceneParts(tmp_path / wrong)


def test_shipped_scenes_pass() -> None:
    paths = sorted((ROOT / "scenes").rglob("*.xml"))
    assert paths
    for path in paths:
        SceneParts(path, {"size": 24}).check()
