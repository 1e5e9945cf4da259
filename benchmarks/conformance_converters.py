"""What converters keep of the splats of the conformance pack.

    pip install gsply==0.4.6 gaussforge==0.6.0
    npm install --prefix benchmarks/conformance/splat-transform
    python benchmarks/conformance_converters.py splat-transform
    python benchmarks/conformance_converters.py gsply --python OTHER/bin/python

Writes NAME/result.json. `--python` runs a converter in an environment of its own.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from mi_splat.cli.conform_read import compare_files
from mi_splat.conformance import conformance_scenes

HERE = Path(__file__).parent / "conformance"
PLY = HERE.parents[1] / "scenes" / "conformance" / "splats"
GSPLY = """
import gsply
splat = gsply.plyread(source)
if target.endswith(".spz"):
    gsply.write_spz(target, splat)
else:
    gsply.plywrite(target, splat, compressed=".compressed." in target)
"""
GAUSSFORGE = """
import gaussforge
ending = target.partition(".")[2]
name = "compressed.ply" if ending == "compressed.ply" else ending
with open(source, "rb") as file:
    made = gaussforge.GaussForge().convert(file.read(), "ply", name)
if "error" in made:
    sys.exit(made["error"])
with open(target, "wb") as file:
    file.write(made["data"])
"""
VERSION = "import importlib.metadata as m; print(m.version({!r}))"


class Converter(NamedTuple):
    """A program that writes splats in other formats."""

    endings: tuple[str, ...]
    code: str | None  # Python from `source` to `target`; None runs what npm installed


CONVERTERS = {
    "splat-transform": Converter(
        (".ply", ".compressed.ply", ".spz", ".sog", ".glb"), None
    ),
    "gsply": Converter((".ply", ".compressed.ply", ".spz"), GSPLY),
    "gaussforge": Converter(
        (".ply", ".compressed.ply", ".spz", ".sog", ".splat"), GAUSSFORGE
    ),
}


def measured(name: str, python: str) -> dict[str, Any]:
    """What a converter keeps, by the ending of its files."""
    converter = CONVERTERS[name]
    scenes = {scene.name: scene for scene in conformance_scenes()}
    formats = {}
    for ending in converter.endings:
        with TemporaryDirectory() as made:
            refused = {}
            for scene in scenes:
                source = PLY / f"{scene}.ply"
                target = Path(made) / f"{scene}{ending}"
                said = _converted(converter, python, source, target)
                if said is not None:
                    refused[scene] = said
            rows = compare_files(Path(made), scenes)
            for row in rows:
                row["text"] = row["text"].replace(f"{made}/", "")[:120]
        formats[ending] = {
            "conform": [row["name"] for row in rows if row["conforms"]],
            "differ": {row["name"]: row["text"] for row in rows if not row["conforms"]},
            "refused": refused,
        }
    return {"version": _version(name, converter, python), "formats": formats}


def _converted(
    converter: Converter, python: str, source: Path, target: Path
) -> str | None:
    """Why a converter has refused a file; None where it has not."""
    if converter.code is None:
        program = HERE / "splat-transform" / "node_modules" / ".bin" / "splat-transform"
        words: Sequence[str] = [
            str(program),
            "-q",
            "-g",
            "cpu",
            str(source),
            str(target),
        ]
    else:
        code = f"import sys\nsource, target = sys.argv[1:]\n{converter.code}"
        words = [python, "-c", code, str(source), str(target)]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode == 0 and target.is_file():
        return None
    target.unlink(missing_ok=True)
    lines = done.stderr.strip().splitlines() or ["no file"]
    return lines[-1].replace(str(source.parent), "")[:200]


def _version(name: str, converter: Converter, python: str) -> str:
    if converter.code is None:
        wanted = json.loads((HERE / name / "package.json").read_text())
        return str(wanted["dependencies"]["@playcanvas/splat-transform"])
    words = [python, "-c", VERSION.format(name)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def main() -> None:
    """Measure a converter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=CONVERTERS)
    parser.add_argument("--python", default=sys.executable)
    options = parser.parse_args()
    found = measured(options.name, options.python)
    folder = HERE / options.name
    folder.mkdir(exist_ok=True)
    (folder / "result.json").write_text(f"{json.dumps(found, indent=1)}\n")
    for ending, row in found["formats"].items():
        counts = {key: len(names) for key, names in row.items()}
        sys.stdout.write(f"{options.name} {ending} {counts}\n")


if __name__ == "__main__":
    main()
