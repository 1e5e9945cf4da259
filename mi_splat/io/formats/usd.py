"""OpenUSD with prims of the schema `ParticleField3DGaussianSplat` (OpenUSD 26.03);
needs the extra `usd`.

Source: pxr/usd/usdVol/schema.usda of github.com/PixarAnimationStudios/OpenUSD. Scales
are standard deviations, opacities are in 0..1, and SH stand Gaussian by Gaussian,
coefficient by coefficient, in the basis of 3DGS. Floats come before halves
(`positions`, `positionsh`). Where y points up, the scene is turned by half a turn about
z, as for glTF; where z points up, y is made to before. Where a stage says how many
metres a unit has, the splat comes in metres.
"""

import dataclasses
import importlib.util
import io
import math
import os
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mi_splat.errors import install
from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats import axes, usd_child
from mi_splat.io.formats.format import Format, Saving
from mi_splat.io.loaded import (
    FREE_GAUSSIANS,
    HIGHER_BANDS,
    Array,
    Arrays,
    Encoded,
    Loaded,
    Notice,
    validated,
)
from mi_splat.io.parsing import Fields, parse
from mi_splat.maths.sh import degree_of

_WRITER = "mi-splat"
_ANSWER_LIMIT = 1 << 22
_SHOWN = 4096  # bytes of what the process said last
_Y_UP = {
    "Y": np.eye(4),
    "Z": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
}
_THREADS = (
    "PXR_WORK_THREAD_LIMIT",
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MALLOC_ARENA_MAX",
)
_ONE_THREAD = dict.fromkeys(_THREADS, "1")
"""Threads take address space, which the child has little of."""


def read_usd(file: io.FileIO, path: str) -> Loaded:
    """Read the splats of an OpenUSD file, each placed by the transforms above it.

    The file is read by a process of its own, which has limits (`usd_child`). No other
    file is opened: whatever asks for one is refused, and so are references, variants
    and inherited prims inside of the file.
    """
    file.seek(0)
    head = file.read(4)
    ending = {b"#usd": ".usda", b"PK\x03\x04": ".usdz"}.get(head, ".usdc")
    most = FREE_GAUSSIANS + os.fstat(file.fileno()).st_size
    with TemporaryDirectory() as folder:
        # usd-core reads more into a name than that of a file
        link = Path(folder, f"splat{ending}")
        link.symlink_to(os.path.abspath(path))
        answer = _ask(path, link, most)
        if "refused" in answer.values:
            expected, got, do = answer.texts("refused", 3)
            raise SplatFileError.of(path, expected, got, do)
        values = np.fromfile(Path(folder, "values"), np.float32)
    parts = answer.objects("parts")
    up = answer.text("up")
    metres = answer.number("metres")
    others = answer.whole("others", 0, 1 << 31)
    if not parts and answer.values.get("nurec"):
        do = (
            "export it as ParticleField3DGaussianSplat or PLY, with 3dgrut's exporter"
            " (3DGRUT, Isaac Sim 6.0 or newer)"
        )
        raise SplatFileError.of(
            path, f"a visible prim of type {usd_child.SPLAT}", "a NuRec volume", do
        )
    if not parts:
        got = f"none, but {others} other prims" if others else "none"
        raise SplatFileError.of(
            path,
            f"a visible prim of type {usd_child.SPLAT}",
            got,
            "export the splat again",
        )
    if up not in _Y_UP or not 0 < metres < math.inf:
        raise SplatFileError.of(
            path,
            "y or z up, and a positive size of units",
            f"{up}, {metres:g}",
            "repair it",
        )
    frame = np.diag([metres, metres, metres, 1.0]) @ _Y_UP[up]
    notices: list[Notice] = []
    if others:
        notices.append(
            ("visible splats only", f"{others} other prims", "they were left out")
        )
    if any(part.whole("degree", 0, 99) > 3 for part in parts):
        notices.append(HIGHER_BANDS)
    loaded: list[Loaded] = []
    for part in parts:
        matrix = np.array(part.numbers("matrix", 16, 16)).reshape(4, 4)
        gaussians, values = _gaussians(part, values)
        loaded.append(axes.transformed(gaussians, frame @ matrix, path))
    whole = axes.concatenated(loaded)
    arrays = axes.flipped(whole.arrays, axes.Z)
    # What this program wrote has the axes of its own scenes.
    up_axis = None if answer.values.get("comment") == _WRITER else axes.Y_UP
    return dataclasses.replace(
        whole, arrays=arrays, notices=tuple(notices), format_up=up_axis
    )


def _ask(path: str, link: Path, most: int) -> Fields:
    """What the child process says of a file; the values of its Gaussians lie beside the
    link then.
    """
    command = [
        sys.executable,
        str(Path(usd_child.__file__).resolve()),
        str(link),
        str(link.parent),
        str(most),
    ]
    said = Path(link.parent, "said")
    # and not a pipe: the limit of files holds for what it says, too
    with said.open("wb") as output:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            # Where usd-core crashes it writes a stack trace into the folder of
            # temporary files.
            env={**os.environ, **_ONE_THREAD, "TMPDIR": str(link.parent)},
        )
    try:
        with Path(link.parent, "answer.json").open("rb") as file:
            answer = file.read(_ANSWER_LIMIT + 1)
    except FileNotFoundError:
        with said.open("rb") as file:
            file.seek(max(0, said.stat().st_size - _SHOWN))
            message = file.read().decode(errors="replace").strip().splitlines()
        if done.returncode < 0:
            why = f"signal {-done.returncode}"
        else:
            why = (message or ["no answer"])[-1][:160]
        got = (
            f"one that usd-core does not get through within its memory and time ({why})"
        )
        raise SplatFileError.of(
            path, "an OpenUSD file that is intact", got, "export it again"
        ) from None
    return parse(answer, path, limit=_ANSWER_LIMIT)


def _gaussians(part: Fields, values: Array) -> tuple[Loaded, Array]:
    """The Gaussians of a prim, and the values of those that follow."""
    count = part.whole("count", 0, len(values))
    degree = part.whole("degree", 0, 99)
    shapes = [
        (count, 3),
        (count, 3),
        (count, 4),
        (count,),
        (count, (degree + 1) ** 2, 3),
    ]
    arrays: list[Array] = []
    for shape in shapes:
        size = math.prod(shape)
        arrays.append(values[:size].reshape(shape))
        values = values[size:]
    means, scales, quaternions, opacities, sh = arrays
    return (
        validated(means, scales, quaternions[:, [3, 0, 1, 2]], opacities, sh[:, :16]),
        values,
    )


def write_usd(arrays: Arrays, saving: Saving) -> Encoded:
    """A scene as an OpenUSD file with one prim, y up, one metre a unit; nothing is
    rounded.
    """
    from pxr import Sdf, Usd, UsdGeom, UsdVol, Vt

    turned = axes.flipped(arrays, axes.Z)
    means, scales, rotations, opacities, sh = (
        np.ascontiguousarray(value) for value in turned.values()
    )
    is_package = saving.suffix == ".usdz"
    layer_suffix = ".usdc" if is_package else saving.suffix
    layer = Sdf.Layer.CreateAnonymous(layer_suffix)
    layer.comment = _WRITER
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Splat").GetPrim()
    stage.SetDefaultPrim(prim)
    columns = {
        "positions": Vt.Vec3fArray.FromNumpy(means),
        "scales": Vt.Vec3fArray.FromNumpy(scales),
        "orientations": Vt.QuatfArray.FromNumpy(
            np.ascontiguousarray(rotations[:, [1, 2, 3, 0]])
        ),
        "opacities": Vt.FloatArray.FromNumpy(opacities),
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(
            sh.reshape(-1, 3)
        ),
        "radiance:sphericalHarmonicsDegree": degree_of(sh.shape[1]),
    }
    if len(means):
        reach = 3 * scales.max(axis=1, keepdims=True)
        extent = np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])
        columns["extent"] = Vt.Vec3fArray.FromNumpy(extent.astype(np.float32))
    for name, value in columns.items():
        prim.GetAttribute(name).Set(value)
    with TemporaryDirectory() as folder:
        path = os.path.join(folder, f"splat{layer_suffix}")
        layer.Export(path)
        data = Path(path).read_bytes()
    return Encoded(_package(data) if is_package else data, ())


def _package(layer: bytes) -> bytes:
    """A .usdz of one binary layer: a zip without compression, whose member begins at
    byte 64.
    """
    # of 1980, so that equal splats have equal files
    member = zipfile.ZipInfo("splat.usdc")
    member.extra = struct.pack("<HH20x", 0x1986, 20)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(member, layer)
    return buffer.getvalue()


def require_usd(path: str) -> None:
    """Raise unless the package that reads and writes OpenUSD is installed."""
    if importlib.util.find_spec("pxr") is None:
        expected = "the package usd-core, for files of OpenUSD"
        do = f"{install('usd')}, or use .glb"
        raise SplatFileError.of(path, expected, "none", do)


USDC = Format(
    name="usdc",
    suffixes=(".usdc",),
    magic=(b"PXR-USDC",),
    read=read_usd,
    write=write_usd,
    check=require_usd,
)
USDA = Format(
    name="usda",
    suffixes=(".usda",),
    magic=(b"#usda",),
    read=read_usd,
    write=write_usd,
    check=require_usd,
)
USDZ = Format(
    name="usdz",
    suffixes=(".usdz",),
    magic=(b"PK\x03\x04",),
    read=read_usd,
    write=write_usd,
    check=require_usd,
)
