"""The doors of the packages: what reads files of others, found in the source and in the
registries.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.project.layers import ROOT

PACKAGES = ("mi_splat", "attacks")
_NAMES = ("read_", "load_", "open_", "recorded_")
"""What the name of a public reader begins with."""
_FILES = ("Path", "PathLike", "FileIO", "bytes")
"""What it takes."""
_DECODERS = {
    *(
        "json.loads",
        "json.load",
        "tomllib.load",
        "tomllib.loads",
        "pickle.load",
        "pickle.loads",
    ),
    *(
        "np.load",
        "torch.load",
        "load_file",
        "safe_open",
        "pl.read_csv",
        "pl.scan_csv",
        "csv.reader",
    ),
    *("Image.open", "zipfile.ZipFile", "tarfile.open", "gzip.open", "gzip.decompress"),
    *("lzma.open", "lzma.LZMADecompressor", "zlib.decompressobj", "zlib.decompress"),
    *("ElementTree.parse", "ElementTree.fromstring", "ElementTree.XMLParser"),
    *(
        "mi.load_file",
        "mi.Bitmap",
        "DocumentReader",
        "read_json",
    ),
}
"""What turns bytes of others into values."""
_MAY_READ = re.compile(
    "|".join([*(f"^def {name}" for name in _NAMES), *map(re.escape, _DECODERS)]),
    re.MULTILINE,
)


@cache
def _trees() -> dict[str, ast.Module]:
    """The modules of the packages that may read files, by their names."""
    trees = {}
    for package in PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            text = file.read_text("utf-8")
            if _MAY_READ.search(text):  # parsing all modules takes seconds
                trees[_module(file)] = ast.parse(text)
    return trees


def _module(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


def public_readers() -> set[str]:
    """`module:function` of every public function that is called as a reader and takes a
    file or its bytes.
    """
    found = set()
    for module, tree in _trees().items():
        for node in tree.body:
            if (
                isinstance(node, ast.FunctionDef)
                and node.name.startswith(_NAMES)
                and _takes_file(node)
            ):
                found.add(f"{module}:{node.name}")
    return found


def _takes_file(function: ast.FunctionDef) -> bool:
    arguments = [*function.args.posonlyargs, *function.args.args]
    hints = (
        ast.unparse(argument.annotation)
        for argument in arguments[:1]
        if argument.annotation
    )
    return any(name in hint for hint in hints for name in _FILES)


def decoding_modules() -> set[str]:
    """Modules in which bytes become values."""
    return {
        module for module, tree in _trees().items() if set(_called(tree)) & _DECODERS
    }


def _called(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func)
