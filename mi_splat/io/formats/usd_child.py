"""The program that reads an OpenUSD file for `mi_splat.io.formats.usd`, in a process of
its own.

usd-core takes the memory that a file asks for, and may end the process over a damaged
one. Here that ends a process that had a limit of memory and of time, and no other. This
file imports nothing of mi_splat, so that it starts fast.
"""

import contextlib
import ctypes
import json
import os
import re
import resource
import signal
import sys
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

SPLAT = "ParticleField3DGaussianSplat"
NUREC = "omni:nurec:isNuRecVolume"
"""An attribute of the volumes that NVIDIA's NuRec wrote before the schema of splats."""
MOST_PARTS = 1000
_LONGEST_COMMENT = 80
ARCS = (
    "references",
    "payload",
    "inheritPaths",
    "specializes",
    "variantSetNames",
    "clips",
)
"""What a prim may say to be made of other prims or files."""

_MEMORY = 2 << 30
_MEMORY_A_BYTE = 32
_SECONDS = 30
_BYTES_A_SECOND = 1 << 20
_SMALLEST_FILE = 1 << 22
_BYTES_A_GAUSSIAN = 4 * (3 + 3 + 4 + 1 + 3 * 25)
_SET_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of linux/prctl.h
_HIGHEST_DEGREE = 4
_COLUMNS = {
    "positions": ("Vec3", 3),
    "scales": ("Vec3", 3),
    "orientations": ("Quat", 4),
    "opacities": ("", 1),
}
_SH = "radiance:sphericalHarmonics"


class RefusedError(Exception):
    """The file is not read: what was expected, what was found and what to do."""


def _limit(size: int, most: int) -> None:
    """Limit this process to what a file of `size` bytes, with `most` Gaussians, may
    need: memory, time and files.
    """
    limits = {
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_FSIZE: _SMALLEST_FILE + _BYTES_A_GAUSSIAN * most,
        resource.RLIMIT_AS: _MEMORY + _MEMORY_A_BYTE * size,
        resource.RLIMIT_CPU: _SECONDS + size // _BYTES_A_SECOND,
    }
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        try:
            resource.setrlimit(kind, (most, most))
        except (OSError, ValueError):
            continue  # macOS has no limit of address space


def _end_with_parent() -> None:
    """Let the system end this process when the one that started it ends, however that
    happens; only Linux can.
    """
    parent = os.getppid()
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:  # it has ended before
        os._exit(1)


def read(path: str, out: BinaryIO, most: int) -> dict[str, Any]:
    """Write the Gaussians of a file as float32, and say how they lie."""
    from pxr import Sdf, Usd, UsdGeom

    if not Usd.SchemaRegistry().FindConcretePrimDefinition(SPLAT):
        version = ".".join(map(str, Usd.GetVersion()[1:]))
        raise RefusedError(
            "usd-core 26.3 or newer", version, "pip install --upgrade usd-core"
        )
    layer = Sdf.Layer.OpenAsAnonymous(path)
    if layer is None:
        raise RefusedError("an OpenUSD file", "another one", "export it again")
    _check_alone(layer, Sdf)
    stage = Usd.Stage.Open(layer, Usd.Stage.LoadNone)
    cache = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    parts: list[dict[str, Any]] = []
    others = total = 0
    nurec = False
    for prim in _shapes(stage, Usd, UsdGeom):
        shown = UsdGeom.Imageable(prim)
        hidden = shown.ComputeVisibility() == "invisible" or shown.ComputePurpose() in (
            "guide",
            "proxy",
        )
        if prim.GetTypeName() != SPLAT or hidden:
            others += 1
            nurec = nurec or bool(prim.HasAttribute(NUREC))
            continue
        if len(parts) == MOST_PARTS:
            raise RefusedError(f"at most {MOST_PARTS} splats", "more", "merge them")
        _check_still(prim, UsdGeom)
        part = _splat(prim, Usd.TimeCode.EarliestTime(), out, most - total)
        total += part["count"]
        parts.append(
            {
                **part,
                "matrix": (
                    np.array(cache.GetLocalToWorldTransform(prim)).T.ravel().tolist()
                ),
            }
        )
    has_unit = stage.HasAuthoredMetadata("metersPerUnit")
    metres = UsdGeom.GetStageMetersPerUnit(stage) if has_unit else 1.0
    about = {"comment": str(layer.comment)[:_LONGEST_COMMENT], "nurec": nurec}
    up = str(UsdGeom.GetStageUpAxis(stage))
    return {"up": up, "metres": metres, "others": others, "parts": parts, **about}


def _check_alone(layer: Any, sdf: Any) -> None:
    """Refuse references: other files are never opened, and a few inside of the file ask
    for any number of prims.
    """
    references = [f"sublayer {name}" for name in layer.subLayerPaths[:1]]

    def look(path: Any) -> None:
        spec = layer.GetObjectAtPath(path)
        if not references and isinstance(spec, sdf.PrimSpec):
            references.extend(f"{arc} of {path}" for arc in ARCS if spec.HasInfo(arc))

    layer.Traverse("/", look)
    references += map(str, layer.GetCompositionAssetDependencies())
    if references:
        do = (
            "put it into one layer with `usdcat --flatten IN.usd -o OUT.usdc`, where"
            " you trust the other files"
        )
        raise RefusedError(
            "a layer that is made of no other prims, variants or files",
            references[0],
            do,
        )


def _shapes(stage: Any, usd: Any, geom: Any) -> Iterator[Any]:
    """Prims that draw something, not those below an instancer."""
    prims = iter(usd.PrimRange.Stage(stage))
    for prim in prims:
        if prim.IsA(geom.PointInstancer):
            prims.PruneChildren()
            yield prim
        elif prim.IsA(geom.Gprim):
            yield prim


def _check_still(prim: Any, geom: Any) -> None:
    """Raise if a prim, or one above it, moves or changes with time."""
    above = prim
    while above:
        names = [
            attribute.GetName()
            for attribute in above.GetAttributes()
            if attribute.ValueMightBeTimeVarying()
        ]
        moving = [
            name for name in names if above == prim or name.startswith("xformOp:")
        ]
        if moving:
            got = f"{moving[0]} of {above.GetPath()}"
            raise RefusedError(
                "a splat that stands still", got, "export one frame of it"
            )
        above = above.GetParent()


def _splat(prim: Any, moment: Any, out: BinaryIO, most: int) -> dict[str, Any]:
    """Write the Gaussians of a prim; their number and SH degree.

    What is not there is as the schema says.
    """
    positions = _values(prim, "positions", moment, *_COLUMNS["positions"])
    if positions is None:
        raise RefusedError("positions", f"none in {prim.GetPath()}", "export it again")
    count = len(positions)
    if count > most:
        raise RefusedError(
            f"at most {most} Gaussians",
            f"{count}: this may be a decompression bomb",
            "ask for a PLY",
        )
    columns = {
        name: _values(prim, name, moment, *shape) for name, shape in _COLUMNS.items()
    }
    sh = _values(prim, f"{_SH}Coefficients", moment, "Vec3", 3)
    degree = 0 if sh is None else prim.GetAttribute(f"{_SH}Degree").Get(moment)
    if not isinstance(degree, int) or not 0 <= degree <= _HIGHEST_DEGREE:
        raise RefusedError(
            f"an SH degree of 0 to {_HIGHEST_DEGREE}",
            repr(degree)[:40],
            "export it again",
        )
    coefficients = (degree + 1) ** 2
    default = {"scales": [1, 1, 1], "orientations": [0, 0, 0, 1], "opacities": [1]}
    for name, values in columns.items():
        out.write(_rows(name, values, count, default.get(name, [])).tobytes())
    out.write(
        _rows(f"{_SH}Coefficients", sh, count * coefficients, [0, 0, 0]).tobytes()
    )
    return {"count": count, "degree": degree}


def _values(
    prim: Any, name: str, moment: Any, kind: str, width: int
) -> NDArray[np.generic] | None:
    """(N, width) values of an attribute, in floats if there are, else in halves; None
    if it has none.
    """
    for full, ending in ((name, "f"), (f"{name}h", "h")):
        attribute = prim.GetAttribute(full)
        if not attribute or not attribute.HasAuthoredValue():
            continue
        value = attribute.Get(moment)
        if kind:
            wanted = f"{kind}{ending}Array"
        else:
            wanted = {"f": "FloatArray", "h": "HalfArray"}[ending]
        if type(value).__name__ != wanted:
            got = f"{type(value).__name__} in {prim.GetPath()}"
            raise RefusedError(f"{full} as {wanted}", got, "export it again")
        return np.asarray(value).reshape(-1, width)
    return None


def _rows(
    name: str, values: NDArray[np.generic] | None, count: int, default: list[int]
) -> NDArray[np.float32]:
    if values is None:
        return np.tile(np.array(default, np.float32), (count, 1))
    if len(values) != count:
        raise RefusedError(
            f"{count} values of {name}", str(len(values)), "export it again"
        )
    return values.astype(np.float32)


def main(path: str, folder: str, most: str) -> None:
    """Read `path` and write `values` and `answer.json` to `folder`."""
    _end_with_parent()
    _limit(os.stat(path).st_size, int(most))
    try:
        with open(os.path.join(folder, "values"), "wb") as out:
            answer = read(path, out, int(most))
    except RefusedError as refused:
        answer = {"refused": [word[:160] for word in refused.args]}
    except (RuntimeError, MemoryError, ValueError, OSError) as error:
        answer = {
            "refused": [
                "an OpenUSD file that is intact",
                _words(error).replace(path, "it"),
                "export it again",
            ]
        }
    with open(os.path.join(folder, "answer.json"), "w") as file:
        json.dump(answer, file)


def _words(error: Exception) -> str:
    """What usd-core says, without where in its code it was said; or the kind of
    error.
    """
    try:
        text = " ".join(str(error).split())
    except UnicodeDecodeError:
        text = ""  # a message that quotes bytes of the file
    match = re.search(r" : '(.*)", text)
    return (match[1].rstrip("' ") if match else text)[:160] or type(error).__name__


if __name__ == "__main__":
    del sys.path[0]  # this folder, whose modules are no packages
    main(*sys.argv[1:])
