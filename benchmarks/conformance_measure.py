"""What web viewers draw of the conformance pack, and whether their adapters are right.

    cd benchmarks/conformance/spark && npm install
    python benchmarks/conformance_measure.py benchmarks/conformance/spark/adapter.js

Writes result.json, or result-precise.json of adapter-precise.js, beside the adapter.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import conformance_probes as probes

from mi_splat.cli.conform_browser import draw_in_browser
from mi_splat.conformance import Report, compare, conformance_scenes

PROFILE = "webgl"


def measured(adapter: Path) -> dict[str, Any]:
    """The result of an adapter.

    Args:
        adapter: JavaScript beside a package.json and installed packages.
    """
    scenes = {scene.name: scene for scene in conformance_scenes()}
    with TemporaryDirectory() as made:
        images = Path(made) / "images"
        draw_in_browser(adapter, images, scenes)
        report = compare(images, PROFILE)
    return {
        "packages": _packages(adapter.parent),
        "browser": _browser(),
        "probes": probes.measured(probes.drawn_in_browser(adapter)),
        "images": _counted(report),
    }


def _packages(folder: Path) -> dict[str, str]:
    """The versions that are installed, which are those of package.json."""
    wanted = json.loads((folder / "package.json").read_text())["dependencies"]
    for name, version in wanted.items():
        found = folder / "node_modules" / name / "package.json"
        installed = json.loads(found.read_text())["version"]
        assert installed == version, f"{name}: {installed}; run npm install"
    return dict(wanted)


def _browser() -> str:
    chromium = shutil.which("chromium") or "chromium"
    said = subprocess.run([chromium, "--version"], capture_output=True, text=True)
    return said.stdout.strip()


def _counted(report: Report) -> dict[str, Any]:
    """A report without what the scenes have in common."""
    return {
        "conform": [row.name for row in report.scenes if row.conforms],
        "differ": {row.name: row.text for row in report.scenes if not row.conforms},
        "causes": {cause.deviation.key: cause.scenes for cause in report.causes},
        "unexplained": report.unexplained,
        "missing": report.missing,
    }


def main() -> None:
    """Measure an adapter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("adapter", type=Path)
    adapter = parser.parse_args().adapter
    found = measured(adapter)
    name = adapter.stem.replace("adapter", "result")
    text = json.dumps(found, indent=1)
    adapter.with_name(f"{name}.json").write_text(f"{text}\n")
    sys.stdout.write(f"{json.dumps(found['probes'], indent=1)}\n")


if __name__ == "__main__":
    main()
