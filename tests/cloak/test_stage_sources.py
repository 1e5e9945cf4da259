"""Whoever changes the code behind a stage of a CLOAK study says whether it makes something else of the same input.

stage_sources.json holds, for each stage, its version and a digest of the source that the version was given to. When a
source has changed: raise the stage's number in `attacks.cloak.study.cache.STAGE_VERSIONS` if the stage makes something
else now, leave it if it does not, and write the file anew with `python -m tests.cloak.test_stage_sources`.
"""

from __future__ import annotations

import ast
import hashlib
import json
from pathlib import Path

import pytest

from attacks.cloak.study.cache import STAGE_VERSIONS
from tests.project.layers import ROOT

RECORD = Path(__file__).with_name("stage_sources.json")
_MESHES = ("mi_splat/assets", "mi_splat/capture/path_tracer.py", "mi_splat/capture/mitsuba_meshes.py")
_OF_APPEARANCES = ("appearances", "correction", "emphasis", "ground_look", "mesh_edits", "mesh_scene")
_APPEARANCES = tuple(f"attacks/cloak/{name}.py" for name in _OF_APPEARANCES)
_KEPT = "attacks/cloak/study/kept_pictures.py"
_NEAR = "mi_splat/bounds.py"
_SETUP = ("attacks/cloak/study/setup.py", "attacks/cloak/study/pipeline.py", "mi_splat/camera_sets.py")
SOURCES: dict[str, tuple[str, ...]] = {
    "pictures": (*_MESHES, *_SETUP, "mi_splat/capture", "mi_splat/datasets/writing.py"),
    "appearance": (*_MESHES, *_SETUP, *_APPEARANCES, _KEPT),
    "poisoned": (
        *(*_MESHES, *_SETUP, *_APPEARANCES),
        *("attacks/cloak/poisoning.py", "attacks/cloak/triggers.py", "mi_splat/directions.py"),
    ),
    "splat": (
        _NEAR,
        "attacks/cloak/study/pipeline.py",
        "mi_splat/training",
        "mi_splat/rasterization",
        "mi_splat/rendering.py",
        "mi_splat/io/parameters.py",
    ),
    "layers": (
        *(_NEAR, *_SETUP, "attacks/cloak/study/layering.py", "attacks/cloak/layered", "attacks/cloak/triggers.py"),
        *("mi_splat/training", "mi_splat/rasterization", "mi_splat/rendering.py", "mi_splat/selection/masks.py"),
        *("mi_splat/frozen_view.py", "mi_splat/view_freezing.py"),
    ),
    "cleaned": (
        *("attacks/cloak/cleaning.py", "attacks/cloak/study/trained_splats.py"),
        *("mi_splat/selection/clusters.py", "mi_splat/selection/neighbours.py", "mi_splat/io/parameters.py"),
    ),
    "true_pictures": (*_MESHES, *_SETUP, *_APPEARANCES, _KEPT),
    "observations": (
        _NEAR,
        *(*_SETUP, "attacks/cloak/study/observations.py", "attacks/cloak/transition.py", "attacks/cloak/triggers.py"),
        *("attacks/evaluation/views.py", "mi_splat/io/images.py", "attacks/objectives.py"),
        *("mi_splat/rasterization", "mi_splat/rendering.py", "mi_splat/metrics.py"),
        *("attacks/detectors/torchvision", "attacks/detectors/ultralytics.py"),
    ),
    "view_reports": (
        _NEAR,
        *(*_SETUP, "attacks/cloak/experiments/view_reports.py", "attacks/cloak/triggers.py"),
        *("mi_splat/io/images.py", "attacks/objectives.py", "mi_splat/rasterization", "mi_splat/rendering.py"),
        *("attacks/detectors/torchvision", "attacks/detectors/ultralytics.py", "attacks/detectors/coco"),
        "attacks/detectors/tfjs",
    ),
}
"""Files, and folders of files, in which a change may change what a stage makes."""


def source_digest(stage: str) -> str:
    """Digest of the code behind a stage; lines that are comments or docstrings have no part in it."""
    total = hashlib.sha256()
    for entry in SOURCES[stage]:
        path = ROOT / entry
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            text = file.read_text()
            lines = dict(enumerate(text.splitlines(), 1))
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Expr) and isinstance(
                    node.value, ast.Constant
                ):  # a docstring, or one of a value
                    for number in range(node.lineno, (node.end_lineno or node.lineno) + 1):
                        lines.pop(number, None)
            code = [line.rstrip() for line in lines.values() if line.strip() and not line.strip().startswith("#")]
            total.update("\n".join([file.relative_to(ROOT).as_posix(), *code, ""]).encode())
    return total.hexdigest()[:16]


@pytest.mark.parametrize("stage", STAGE_VERSIONS)
def test_the_version_belongs_to_the_source(stage: str) -> None:
    record = json.loads(RECORD.read_text())
    expected = {"version": STAGE_VERSIONS[stage], "source": source_digest(stage)}
    assert record[stage] == expected, f"the code behind stage {stage!r} has changed; see the top of this file"


def test_every_stage_has_a_source() -> None:
    assert set(SOURCES) == set(STAGE_VERSIONS)
    for entries in SOURCES.values():
        assert all((ROOT / entry).exists() for entry in entries)


if __name__ == "__main__":
    found = {stage: {"version": STAGE_VERSIONS[stage], "source": source_digest(stage)} for stage in STAGE_VERSIONS}
    RECORD.write_text(json.dumps(found, indent=2) + "\n")
