"""All rules on one splat: of a file as it is stored, or of a scene in memory."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_splat.audit.lint.cost import SIZE, Overdraw, worst_overdraw
from mi_splat.audit.lint.gltf import validate
from mi_splat.audit.lint.rules import Finding, Stored, findings_of
from mi_splat.errors import listed
from mi_splat.io.camera_records import describe
from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.gltf import open_glb
from mi_splat.io.loaded import Arrays, Loaded, arrays_of, as_scene
from mi_splat.io.splat_files import load_stored
from mi_splat.scene import GaussianScene

FILL = 1000.0
"""`fillRatio` from which a splat is told: healthy ones have ones to hundreds, says splat-transform."""


_RENDER_MODE = (
    "The file says that it was trained with antialiasing (the 2D filter of Mip-Splatting). "
    "A renderer that ignores this draws small Gaussians too thick."
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
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

    def __repr__(self) -> str:
        count = "unread" if self.gaussians is None else f"{self.gaussians:,} Gaussians"
        return f"Lint({count}, findings: {listed(finding.rule for finding in self.findings)})"

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


def lint_file(path: Path, stored: Loaded | None = None) -> Lint:
    """Check a splat file, also one with Gaussians that are not valid; what it holds may have been read already."""
    findings: list[Finding] = []
    data = path.read_bytes() if path.suffix.lower() == ".glb" else b""
    if data.startswith(b"glTF"):
        findings = validate(open_glb(data, str(path)))
    try:
        loaded = stored or load_stored(path)
    except SplatFileError:
        if any(finding.severity == "error" for finding in findings):
            return Lint(findings=tuple(findings))
        raise
    return _lint(loaded, findings)


def lint_scene(scene: GaussianScene) -> Lint:
    """Check a scene."""
    return _lint(Loaded(arrays_of(scene), np.empty(0, np.int64), ""), [])


def _lint(loaded: Loaded, findings: list[Finding]) -> Lint:
    stored = Stored.of(loaded)
    findings = [*findings, *(findings_of(stored) if len(stored.valid) else ())]
    if loaded.is_antialiased:
        findings.append(Finding(rule="render-mode", severity="note", reason=_RENDER_MODE))
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


# `fillRatio` as splat-transform of PlayCanvas defines it (its pull request 289): total footprint over cross-section.
#
# The footprint of a Gaussian is the ellipse of one standard deviation over its two largest axes. The cross-section is
# the mean of the three faces of the box between the 1st and the 99th percentile of the means along the file's axes.
# These come from a histogram of 1024 bins that doubles its range as values arrive, so they are approximate, and are
# made here in the same way: far floaters widen the bins.

BINS = 1024


def fill_ratio(arrays: Arrays) -> float:
    """Roughly the number of Gaussians on a ray through the splat."""
    scales = np.sort(arrays["scales"].astype(np.float64), axis=1)
    areas = np.pi * scales[:, 1] * scales[:, 2]
    if not len(areas):
        return 0.0
    columns = arrays["means"].astype(np.float64).T
    x, y, z = (max(0.0, binned_quantile(values, 0.99) - binned_quantile(values, 0.01)) for values in columns)
    section = (x * y + y * z + z * x) / 3
    if section == 0:  # a stack of Gaussians: how many there are
        section = binned_quantile(areas, 0.5)
    return float(areas.sum() / section)


def binned_quantile(values: NDArray[np.float64], share: float) -> float:
    """A quantile out of a histogram over the range that the order of the values leads to."""
    low, high = _range(values)
    if low == high:
        return low
    width = (high - low) / BINS
    bins = np.bincount(np.minimum(((values - low) / width).astype(np.int64), BINS - 1), minlength=BINS)
    used = np.flatnonzero(bins)
    reached = bins[used].cumsum()
    target = share * len(values)
    index = int(np.searchsorted(reached, target))
    if reached[index] == target and index + 1 < len(used):  # between two bins that hold something
        result = low + (used[index] + 1 + used[index + 1]) / 2 * width
    else:
        before = reached[index] - bins[used[index]]
        result = low + (used[index] + (target - before) / bins[used[index]]) * width
    return float(np.clip(result, values.min(), values.max()))


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    """Begun by the first two different values, and doubled towards each that lies outside."""
    different = np.flatnonzero(values != values[0])
    if not len(different):
        return float(values[0]), float(values[0])
    first, second = float(values[0]), float(values[different[0]])
    low, high = min(first, second), max(first, second)
    lowest, highest = np.minimum.accumulate(values), np.maximum.accumulate(values)
    records = np.flatnonzero((np.diff(lowest) < 0) | (np.diff(highest) > 0)) + 1
    for value in values[records]:
        while value < low:
            low -= high - low
        while value > high:
            high += high - low
    return low, high
