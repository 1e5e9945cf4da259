"""OpenUSD: exact there and back, files by hand as the schema says, transforms, and
files that mean harm.
"""

import json
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from mi_splat.io import SplatFileError, SplatFileWarning, load_splat, save_splat
from mi_splat.io.formats import usd_child
from mi_splat.scene import GaussianScene, Similarity
from tests.gaussians import random_scene
from tests.io.format_files import assert_close

pytest.importorskip("pxr", reason="usd-core is not installed: pip install -e '.[usd]'")

TWO = """
    point3f[] positions = [(1, 2, 3), (4, 5, 6)]
    float3[] scales = [(0.5, 1, 2), (1, 1, 1)]
    quatf[] orientations = [(0.5, 0.5, 0.5, 0.5), (1, 0, 0, 0)]
    float[] opacities = [0.5, 0.25]
    uniform int radiance:sphericalHarmonicsDegree = 1
    float3[] radiance:sphericalHarmonicsCoefficients = [
        (1, 2, 3), (0.5, 0, 0), (0, 0.25, 0), (0, 0, 0.125), (0, 0, 0),
        (0, 0, 0), (1, 1, 1), (0, 0, 0)]
"""


def usda(*prims: str, head: str = 'upAxis = "Y"') -> str:
    return f"#usda 1.0\n(\n{head}\n)\n" + "\n".join(prims)


def splat(values: str = TWO, name: str = "Splat", about: str = "") -> str:
    return f'def ParticleField3DGaussianSplat "{name}" {about}\n{{\n{values}\n}}\n'


def loaded(folder: Path, text: str) -> GaussianScene:
    (folder / "a.usda").write_text(text)
    return load_splat(folder / "a.usda")


@pytest.mark.parametrize(("ending", "degree"), [("usdc", 3), ("usda", 1), ("usdz", 0)])
def test_all_is_kept_to_the_bit(ending: str, degree: int, tmp_path: Path) -> None:
    scene = random_scene(40, degree)
    path = tmp_path / f"a.{ending}"
    save_splat(scene, path)
    assert all(map(torch.equal, load_splat(path).tensors(), scene.tensors()))
    first = path.read_bytes()
    save_splat(scene, path)
    assert path.read_bytes() == first


def test_the_written_stage_is_one_that_other_programs_take(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom

    save_splat(random_scene(0), tmp_path / "none.usdc")
    assert len(load_splat(tmp_path / "none.usdc")) == 0
    scene = random_scene(9, 2)
    save_splat(scene, tmp_path / "a.usdz")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == (
        "Y",
        1,
    )
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    low, high = prim.GetAttribute("extent").Get()
    means = scene.means * torch.tensor([-1.0, -1, 1])
    assert bool(((means >= torch.tensor(low)) & (means <= torch.tensor(high))).all())


def test_a_file_by_hand_has_the_expected_numbers(tmp_path: Path) -> None:
    """y points down in the scene: half a turn about z; so x and y of SH, the second and
    the fourth, change signs.
    """
    scene = loaded(tmp_path, usda(splat()))
    assert scene.means.tolist() == [[-1, -2, 3], [-4, -5, 6]]
    assert scene.scales.tolist() == [[0.5, 1, 2], [1, 1, 1]]
    assert scene.rotations.tolist() == [[0.5, -0.5, -0.5, 0.5], [1, 0, 0, 0]]
    assert scene.opacities.tolist() == [0.5, 0.25]
    assert scene.sh[0].tolist() == [
        [1, 2, 3],
        [-0.5, 0, 0],
        [0, 0.25, 0],
        [0, 0, -0.125],
    ]
    assert scene.sh[1, 2].tolist() == [1, 1, 1]


def test_halves_and_what_is_not_said(tmp_path: Path) -> None:
    """Floats come before halves; what is missing is as the schema says.

    Other shapes are told of.
    """
    values = (
        "point3f[] positions = [(1, 2, 3)]\npoint3h[] positionsh = [(0, 0, 0)]\nhalf3[]"
        " scalesh = [(0.5, 0.25, 1)]"
    )
    hidden = splat(TWO + 'token visibility = "invisible"', "Hidden")
    (tmp_path / "a.usd").write_text(
        usda(splat(values), hidden, 'def Mesh "Chair" {\n}')
    )
    with pytest.warns(
        SplatFileWarning,
        match="visible splats only, got 2 other prims; they were left out",
    ) as caught:
        scene = load_splat(tmp_path / "a.usd")
    assert caught[0].filename == __file__
    assert (scene.means.tolist(), scene.scales.tolist()) == (
        [[-1, -2, 3]],
        [[0.5, 0.25, 1]],
    )
    assert (scene.rotations.tolist(), scene.opacities.tolist()) == ([[1, 0, 0, 0]], [1])
    assert scene.sh.tolist() == [[[0, 0, 0]]]


def test_transforms_up_and_units_place_a_splat(tmp_path: Path) -> None:
    """(1, 2, 3) is doubled, turned by 90 degrees about z, moved, then y is made to
    point up, in metres.
    """
    doubled = splat(
        TWO
        + "float3 xformOp:scale = (2, 2, 2)\n"
        + 'uniform token[] xformOpOrder = ["xformOp:scale"]'
    )
    moved = f"""def Xform "Above" {{
        double3 xformOp:translate = (0, 0, 100)
        float xformOp:rotateZ = 90
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
        {doubled}
    }}"""
    head = 'upAxis = "Z"\nmetersPerUnit = 0.01'
    scene = loaded(tmp_path, usda(moved, splat(name="Second"), head=head))
    torch.testing.assert_close(scene.means[0], torch.tensor([0.04, -1.06, -0.02]))
    plain = loaded(tmp_path, usda(splat()))
    # of (-x, -y, z) into (y, -z, -x)
    turn = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    assert_close(
        scene.select(torch.arange(2)),
        plain.transform(Similarity(turn, torch.tensor([0.0, -1, 0]), 0.02)),
    )
    upright = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert_close(
        scene.select(torch.arange(2, 4)),
        plain.transform(Similarity(upright, torch.zeros(3), 0.01)),
    )


HOSTILE = {
    "passwd": (
        usda(splat(about="(references = @/etc/passwd@</x>)")),
        "references of /Splat",
    ),
    "sublayer": (
        usda(splat(), head="subLayers = [@/etc/passwd@]"),
        "sublayer /etc/passwd",
    ),
    "payload": (
        usda(
            'def "A" (variantSets = "v") {\nvariantSet "v" = {\n"a" {\ndef "B" (payload'
            " = @x.usd@) {\n}\n}\n}\n}"
        ),
        "variantSetNames of /A|payload of",
    ),
    "payload alone": (
        usda(splat(), 'def "B" (payload = @x.usd@) {\n}'),
        "payload of /B",
    ),
    "copies": (
        usda(splat(), 'def "B" (inherits = </Splat>) {\n}'),
        "inheritPaths of /B",
    ),
    "clips": (
        usda(
            'def "B" (clips = {dictionary a = {asset[] assetPaths = [@a.usd@]}}) {\n}'
        ),
        "clips of /B",
    ),
    "high_degree": (
        usda(splat(TWO.replace("Degree = 1", "Degree = 2000000000"))),
        "an SH degree of 0 to 4",
    ),
    "kind": (
        usda(
            splat(
                TWO.replace("float[] opacities = [0.5, 0.25]", 'string opacities = "x"')
            )
        ),
        "FloatArray",
    ),
    "nan": (
        usda(splat(TWO.replace("(1, 2, 3), (4", "(nan, 2, 3), (4"))),
        "a coordinate of the mean is nan",
    ),
    "motion": (
        usda(
            splat(
                "float[] opacities.timeSamples = {0: [1], 1: [0]}\npoint3f[] positions"
                " = [(0, 0, 0)]"
            )
        ),
        "stands still, got opacities of /Splat",
    ),
    "shear": (
        usda(
            splat(
                TWO + "float3 xformOp:scale = (1, 2, 1)\nuniform token[] xformOpOrder ="
                ' ["xformOp:scale"]'
            )
        ),
        "uniform scale",
    ),
    "none": (usda('def Mesh "Chair" {\n}'), "got none, but 1 other prims"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_refused(name: str, tmp_path: Path) -> None:
    text, words = HOSTILE[name]
    with pytest.raises(SplatFileError, match=words) as caught:
        loaded(tmp_path, text)
    assert len(str(caught.value)) < len(str(tmp_path)) + 500


def test_a_crash_of_the_process_that_reads_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """usd-core writes its stack trace into the folder of temporary files."""
    child = tmp_path / "crashing.py"
    child.write_text(
        "import os, tempfile\ntempfile.mkstemp(prefix='st_python')\nos.abort()\n"
    )
    monkeypatch.setattr(usd_child, "__file__", str(child))
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    (tmp_path / "a.usda").write_text(usda(splat()))
    with pytest.raises(SplatFileError):
        load_splat(tmp_path / "a.usda")
    assert list(folder.iterdir()) == []


def test_the_process_that_reads_has_little_memory() -> None:
    program = (
        "from mi_splat.io.formats import usd_child\n"
        "usd_child._limit(1000, 10)\n"
        "try:\n"
        "    bytearray(usd_child._MEMORY + 1000 * usd_child._MEMORY_A_BYTE)\n"
        "except MemoryError:\n"
        "    print('refused')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout == "refused\n"


def test_claims_of_binary_files_do_not_fill_the_memory(tmp_path: Path) -> None:
    """An array that claims 10^12 values, and one array that a hundred prims share."""
    from pxr import Sdf, Usd, Vt

    scene = random_scene(77, 0)
    save_splat(scene, tmp_path / "a.usdc")
    data = (tmp_path / "a.usdc").read_bytes()
    count = data.index(struct.pack("<Qf", 77, -float(scene.means[0, 0])))
    (tmp_path / "a.usdc").write_bytes(
        data[:count] + struct.pack("<Q", 10**12) + data[count + 8 :]
    )
    with pytest.raises(SplatFileError, match="an OpenUSD file that is intact"):
        load_splat(tmp_path / "a.usdc")
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    stage = Usd.Stage.Open(layer)
    for number in range(100):
        prim = stage.DefinePrim(f"/S{number}", "ParticleField3DGaussianSplat")
        prim.GetAttribute("positions").Set(Vt.Vec3fArray(10_000))
    layer.Export(str(tmp_path / "b.usdc"))
    with pytest.raises(
        SplatFileError, match="Gaussians, got 10000: this may be a decompression bomb"
    ):
        load_splat(tmp_path / "b.usdc")


def test_the_process_that_reads_has_limits(tmp_path: Path) -> None:
    """Of memory, time and files, by the size of the file and the Gaussians that it may
    hold.
    """
    code = """
import json, resource
from mi_splat.io.formats import usd_child
usd_child._limit(1 << 20, 1000)
names = ("RLIMIT_AS", "RLIMIT_CPU", "RLIMIT_FSIZE", "RLIMIT_CORE")
print(json.dumps([resource.getrlimit(getattr(resource, name))[0] for name in names]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    memory, seconds, file, core = json.loads(done.stdout)
    if sys.platform == "linux":
        assert memory == (2 << 30) + 32 * (1 << 20)
    assert (seconds, core) == (31, 0)
    assert 4 * 86 * 1000 < file < 1 << 23


@pytest.mark.skipif(
    sys.platform != "linux",
    reason="only Linux ends a process with the one that started it",
)
def test_the_process_that_reads_ends_with_the_one_that_started_it(
    tmp_path: Path,
) -> None:
    many = "".join(f'def Xform "a{number}" {{}}\n' for number in range(600_000))
    (tmp_path / "a.usda").write_text(f"#usda 1.0\n{many}")
    code = (
        "from mi_splat.io.splat_files import load_stored;"
        f" load_stored({str(tmp_path / 'a.usda')!r})"
    )
    reader = subprocess.Popen([sys.executable, "-c", code])
    children = Path(f"/proc/{reader.pid}/task/{reader.pid}/children")
    until(lambda: bool(children.read_text().split()))
    (child,) = map(int, children.read_text().split())
    until(lambda: b"usd_child" in Path(f"/proc/{child}/cmdline").read_bytes())
    time.sleep(0.5)  # until it has asked the system for that
    reader.kill()
    reader.wait()
    until(
        lambda: (
            not Path(f"/proc/{child}").exists()
            or "\nState:\tZ" in Path(f"/proc/{child}/status").read_text()
        ),
        5.0,
    )


def until(condition: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)
