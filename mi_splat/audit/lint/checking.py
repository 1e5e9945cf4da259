"""All rules on one splat: of a file as it is stored, or of a scene in memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_splat.audit.lint.cost import SIZE, Overdraw, worst_overdraw
from mi_splat.audit.lint.fill import fill_ratio
from mi_splat.audit.lint.findings import Finding
from mi_splat.audit.lint.gltf import validate
from mi_splat.audit.lint.rules import RULES, Stored
from mi_splat.io.camera_records import describe
from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.glb import open_glb
from mi_splat.io.loaded import Loaded, as_scene
from mi_splat.io.reading import load_stored
from mi_splat.scene import GaussianScene

FILL = 1000.0
"""`fillRatio` from which a splat is told: healthy ones have ones to hundreds, says splat-transform."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lint:
    """What the rules say of a splat.

    Attributes:
        findings: In the order of the rules.
        gaussians: How many there are, those that are not valid included; None if they could not be read.
        fill_ratio: As splat-transform defines it, of the valid ones.
        overdraw: From the worst camera, of the valid ones; None if there are none.
    """

    findings: tuple[Finding, ...]
    gaussians: int | None = None
    fill_ratio: float | None = None
    overdraw: Overdraw | None = None

    def document(self) -> dict[str, Any]:
        """As JSON can hold it."""
        worst = self.overdraw
        return {
            "lint": [finding.document() for finding in self.findings],
            "cost": {
                "fill_ratio": self.fill_ratio,
                "overdraw": worst
                and {
                    "mean": worst.mean,
                    "highest": worst.highest,
                    "size": SIZE,
                    "cameras": worst.tried,
                    "camera": describe("overdraw", worst.camera),
                },
            },
        }


def lint_file(path: Path) -> Lint:
    """Check a splat file, also one that `load_splat` refuses because Gaussians in it are not valid.

    Args:
        path: A splat file of any format.

    Raises:
        SplatFileError: It cannot be read, for a reason that no rule explains.
    """
    findings: list[Finding] = []
    data = path.read_bytes() if path.suffix.lower() == ".glb" else b""
    if data.startswith(b"glTF"):
        findings = validate(open_glb(data, str(path)))
    try:
        loaded = load_stored(path)
    except SplatFileError:
        if any(finding.severity == "error" for finding in findings):
            return Lint(findings=tuple(findings))
        raise
    return _lint(loaded, findings)


def lint_scene(scene: GaussianScene) -> Lint:
    """Check a scene.

    Args:
        scene: On the CPU.
    """
    return _lint(Loaded.of(scene.detach().to("cpu"), np.empty(0, np.int64), ""), [])


def _lint(loaded: Loaded, findings: list[Finding]) -> Lint:
    stored = Stored.of(loaded)
    rules = RULES if len(stored.valid) else ()
    findings = [*findings, *(finding for rule in rules if (finding := rule(stored)) is not None)]
    valid = (
        {name: value[stored.valid] for name, value in loaded.arrays.items()} if len(loaded.invalid) else loaded.arrays
    )
    ratio = fill_ratio(valid)
    if ratio >= FILL:
        reason = (
            f"The fillRatio of splat-transform is {ratio:,.0f}: so many Gaussians lie on a ray, which is slow to draw."
        )
        findings.append(Finding(rule="fill-ratio", severity="warning", reason=reason))
    worst = worst_overdraw(as_scene(valid))
    if worst is not None and (finding := worst.finding()) is not None:
        findings.append(finding)
    return Lint(findings=tuple(findings), gaussians=len(stored.valid), fill_ratio=ratio, overdraw=worst)
