"""The splat formats: what each keeps of a scene, and which one a file has by its name and its first bytes."""

import importlib.util
import os
from dataclasses import dataclass
from typing import NamedTuple

from mi_splat.errors import install
from mi_splat.io.errors import LFS_ADVICE, LFS_POINTER, SplatFileError


class Precision(NamedTuple):
    """Largest error of a value after it was saved and loaded (0: to the bit), and the range of what is kept."""

    error: float
    of: str = ""
    limits: str = ""

    def __str__(self) -> str:
        """The cell of the table."""
        size = "exact" if not self.error else f"{self.error:.2g} {self.of}"
        return f"{size}, clamped to {self.limits}" if self.limits else size


EXACT = Precision(0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A file format: the largest SH degree that it holds, its precision, and whether Gaussians keep their order."""

    name: str
    suffix: str
    writes: bool = True
    degree: int = 3
    means: Precision = EXACT
    scales: Precision = EXACT
    rotations: Precision = EXACT
    opacities: Precision = EXACT
    colours: Precision = EXACT
    sh: Precision = EXACT
    order: bool = True


_LOG = "of the logarithm"
_BYTE = Precision(0.5 / 255, "of opacity")

FORMATS: tuple[Format, ...] = (
    Format(
        name="3DGS PLY",
        suffix=".ply",
        scales=Precision(8e-6, _LOG),
        opacities=Precision(8e-6, "of opacity"),
    ),
    Format(name="glTF", suffix=".glb"),
    Format(name="OpenUSD", suffix=".usdc"),
    Format(
        name="compressed PLY",
        suffix=".compressed.ply",
        means=Precision(0.5 / 1023, "of the extent of its chunk"),
        scales=Precision(0.5 / 1023, "of the range in its chunk"),
        rotations=Precision(0.3, "degrees"),
        opacities=_BYTE,
        colours=Precision(0.5 / 255, "of the range in its chunk"),
        sh=Precision(1 / 32, "of a coefficient", "-4 to 4"),
        order=False,
    ),
    Format(
        name="SOG",
        suffix=".sog",
        means=Precision(0.5 / 65535, "of the extent, in sign(x) ln(1 + abs(x))"),
        scales=Precision(1 / 254, "of their range"),
        rotations=Precision(1.1, "degrees"),
        opacities=_BYTE,
        colours=Precision(1 / 254, "of their range"),
        sh=Precision(1 / 254, "of their range"),
    ),
    Format(
        name="SPZ",
        suffix=".spz",
        means=Precision(2.0**-22, "of the largest coordinate or of 1"),
        scales=Precision(1 / 32, _LOG, "-10 to 5.94"),
        rotations=Precision(0.3, "degrees"),
        opacities=_BYTE,
        colours=Precision(0.0037, "of full colour", "-0.44 to 1.44"),
        sh=Precision(1 / 256, "of a coefficient", "-1 to 0.99"),
    ),
    Format(
        name="splat",
        suffix=".splat",
        degree=0,
        rotations=Precision(0.9, "degrees"),
        opacities=_BYTE,
        colours=Precision(0.5 / 255, "of full colour", "0 to 1"),
    ),
    Format(
        name="ksplat",
        suffix=".ksplat",
        writes=False,
    ),
)
"""All formats, the most precise first; `ksplat` is read as it is, so that its precision is that of its writer."""

HEAD = 32
"""First bytes of a file that `by_content` looks at."""

META = "meta.json"
"""The file that leads to the pictures of an unbundled SOG."""

USD = (".usdc", ".usda", ".usdz")
"""OpenUSD in binary, as text and as a package; what is called `.usd` is read by its mark."""

SUFFIXES = tuple(sorted({*(entry.suffix for entry in FORMATS), *USD}, key=len, reverse=True))

_MAGIC = {b"ply": ".ply", b"NGSP": ".spz", b"\x1f\x8b": ".spz", b"PK\x03\x04": ".sog", b"glTF": ".glb"}
_MAGIC |= {b"PXR-USDC": ".usdc", b"#usda": ".usda"}
_OTHERS = {
    ".gltf": "pack it into one .glb, for instance with gltf-transform",
    ".obj": "this is a mesh: capture pictures of it with mi-splat capture, and train a splat on them",
    ".lcc": "convert it to .ply with splat-transform",
    ".lcc2": "convert it to .ply with splat-transform",
    ".csv": "save it as .ply; splat-transform writes .csv from that",
    ".html": "save it as .ply; splat-transform makes a page from that",
    ".usd": "call it .usdc or .usda, as what it begins with says",
}
_PROGRAMS = (".pt", ".pth", ".ckpt", ".pkl", ".pickle")
"""Checkpoints of PyTorch: to unpickle one runs what is in it, so none is opened, whatever it begins with."""


def suffix_of(path: str) -> str | None:
    """The suffix of the format that a name promises; None if it ends otherwise."""
    name = os.path.basename(path).lower()
    if name == META or name.endswith("." + META):
        return META
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), None)


def by_content(head: bytes) -> str | None:
    """The suffix of the format whose mark a file begins with; None if it has none (.splat, .ksplat)."""
    return next((suffix for magic, suffix in _MAGIC.items() if head.startswith(magic)), None)


def format_to_read(path: str, head: bytes) -> str:
    """The suffix of the format of a file, ".ply" also for compressed ones, `META` for an unbundled SOG.

    A name that promises nothing is overruled by the file's mark; one that promises something else is an error.
    """
    if os.path.basename(path).lower().endswith(_PROGRAMS):
        raise _unknown(path)
    if head.startswith(LFS_POINTER):
        raise SplatFileError.of(path, "a splat file", *LFS_ADVICE)
    named, marked = suffix_of(path), by_content(head)
    named = ".ply" if named == ".compressed.ply" else named
    if named is None and marked is None:
        raise _unknown(path)
    if named in (None, marked) and marked is not None:
        return marked
    if marked is not None and named in (".splat", ".ksplat", META, *_MAGIC.values()):
        raise SplatFileError.of(path, f"a {named} file", f"the mark of a {marked} file", f"rename it to {marked}")
    return str(named)


def format_to_write(path: str) -> str:
    """The suffix of the format in which a file is to be written."""
    named = suffix_of(path)
    if named is None:
        raise _unknown(path)
    if named == META:
        raise SplatFileError.of(path, "a format that is written", "an unbundled SOG", "save it as .sog")
    if named == ".ksplat":
        do = "save it as .ply and convert that with create-ksplat of GaussianSplats3D"
        raise SplatFileError.of(path, "a format that is written", ".ksplat, which is only read", do)
    if named in USD:
        require_usd(path)
    return named


def require_usd(path: str) -> None:
    """Raise unless the package that reads and writes OpenUSD is installed."""
    if importlib.util.find_spec("pxr") is None:
        expected = "the package usd-core, for files of OpenUSD"
        raise SplatFileError.of(path, expected, "none", f"{install('usd')}, or use .glb")


def _unknown(path: str) -> SplatFileError:
    """The error for a name that fits no format."""
    ending = os.path.splitext(path)[1].lower()
    do = _OTHERS.get(ending, "convert it to .ply, for instance with splat-transform")
    if ending in _PROGRAMS:
        do = (
            "a checkpoint can be a program, and is not opened: export a .ply where you trust it, with ns-export "
            "gaussian-splat of nerfstudio, gsplat.export_splats, or save_ply of 3DGS"
        )
    names = ", ".join(entry.suffix for entry in FORMATS)
    return SplatFileError.of(path, f"a name that ends in {names}", ending or "no ending", do)


def markdown() -> str:
    """The table as docs/formats.md shows it."""
    columns = ("means", "scales", "rotations", "opacities", "colours", "sh")
    titles = ("ends in", "written", "SH degree", "means", "log-scales", "rotations", "opacity", "colour", "SH", "order")
    lines = [f"| {' | '.join(titles)} |", "|" + "---|" * len(titles)]
    for entry in FORMATS:
        kept = [str(getattr(entry, name)) if entry.writes else "as written" for name in columns]
        if not entry.degree:
            kept[-1] = "none"
        start = [f"`{entry.suffix}`", "yes" if entry.writes else "no", f"0 to {entry.degree}" if entry.degree else "0"]
        lines.append(f"| {' | '.join([*start, *kept, 'kept' if entry.order else 'changed'])} |")
    return "\n".join(lines) + "\n"
