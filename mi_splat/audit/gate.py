"""The gate for those who publish splats: what a policy makes of findings, and what
splat a file holds.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from mi_splat.fields import Checked, above, at_least

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mi_splat.io.loaded import Arrays
    from mi_splat.scene import GaussianScene

Claim = Literal["readable", "numbers", "cost", "hidden appearance", "provenance"]
Action = Literal["accept", "quarantine", "refuse"]
Verdict = Literal["accept", "quarantine", "not judged", "refuse"]
CLAIMS: tuple[Claim, ...] = get_args(Claim)
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
"""From the best to the worst; that of a file is the worst of its claims."""
ACTIONS: Mapping[str, Action] = {
    **{"error": "refuse", "warning": "accept", "note": "accept"},
    **dict.fromkeys(("changed", "two-groups"), "quarantine"),
    "differs": "accept",  # as honest files do, too: a reason, and no alarm
    "contradicted": "refuse",
    "unbounded": "refuse",
}
"""What follows from a finding, by its rule or else its severity, where the policy says
nothing.
"""
RESULT = "result.json"
FILE = "{file}"
"""What stands for the name of the judged file in rows and records: they belong to a
content, which has many names.
"""
Row = dict[str, Any]
_CHUNK = 1 << 16


@dataclass(frozen=True, kw_only=True)
class Policy(Checked):
    """What follows from findings, and what judging a file may take."""

    # by the name of a rule or a severity, before `ACTIONS`
    rules: Mapping[str, Action] = field(default_factory=dict)
    # that have to be judged; provenance is where a clean file is named
    claims: tuple[Claim, ...] = CLAIMS[:-1]
    # for a file; what takes longer is not judged
    seconds: Annotated[float, at_least(1, "seconds")] = 120.0
    # of memory for a file, likewise
    megabytes: Annotated[float, at_least(500, "MB")] = 4000.0
    # of a file on the disk; a larger one is not read
    file_megabytes: Annotated[float, at_least(1, "MB")] = 2000.0
    # of more, so many are looked at
    most_gaussians: Annotated[int, at_least(1000, "Gaussians")] = 2_000_000
    # by which a colour may depart from that of band 0 in any direction (`mi-splat
    # bound`); None is as far as it likes
    bounded: Annotated[float, above(0, "sRGB")] | None = None

    def action(self, rule: str, severity: str) -> Action:
        """What follows from a finding: as its rule says, or else its severity; what
        occurs as an error is refused.
        """
        by_rule = None if severity == "error" else ACTIONS.get(rule)
        return (
            self.rules.get(rule)
            or by_rule
            or self.rules.get(severity)
            or ACTIONS.get(severity, "refuse")
        )

    def verdict(self, rows: Iterable[Mapping[str, Any]]) -> Row:
        """The verdict on a file and on each claim, from what was found; what has no row
        was not judged.
        """
        found = list(rows)
        claims = dict[str, Row]()
        for claim in CLAIMS:
            own = [row for row in found if row["claim"] == claim]
            reasons = [
                {key: row[key] for key in ("rule", "severity", "reason")}
                for row in own
                if row["reason"]
            ]
            for reason in reasons:
                rule = reason["rule"]
                reason["verdict"] = (
                    self.action(rule, reason["severity"]) if rule else "not judged"
                )
            marks = [reason["verdict"] for reason in reasons]
            ended = any(row["judged"] and not row["rule"] for row in own)
            worst: Verdict = max(
                [*marks, "accept" if ended else "not judged"], key=VERDICTS.index
            )
            claims[claim] = {"verdict": worst, "reasons": reasons}
        asked = [
            claim
            for claim in CLAIMS
            if claim in self.claims or claims[claim]["verdict"] != "not judged"
        ]
        worst = max((claims[claim]["verdict"] for claim in asked), key=VERDICTS.index)
        return {
            "verdict": worst,
            "claims": claims,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class GateConfig:
    """What of a file is judged, apart from its bytes."""

    claims: tuple[Claim, ...]
    most_gaussians: int
    bounded: float | None = None
    # whether downloaded features compare directions, or a detector only
    features: bool = False
    ending: str  # of its name, by which it is read


def sampled(scene: GaussianScene, most: int) -> GaussianScene:
    """At most so many Gaussians, larger by what covers as much surface; which ones, all
    positions decide.
    """
    import torch

    if len(scene) <= most:
        return scene
    generator = torch.Generator().manual_seed(
        zlib.crc32(scene.means.contiguous().numpy().tobytes())
    )
    rows = torch.randperm(len(scene), generator=generator)[:most].sort().values
    part = scene.select(rows)
    return part.replace(scales=part.scales * math.sqrt(len(scene) / most))


def fingerprint(arrays: Arrays) -> str:
    """Hex digits, two for each moment of a splat; empty if no Gaussian is finite and
    visible.

    Moments are sums over the Gaussians, weighted by opacity, so their order does not
    count: number, extents along the principal axes, how sizes, opacities and colours
    are distributed, and colours near the middle. Each is rounded to one of 256 steps,
    by far more than formats round, so that in another format a few of them differ by 1.
    SH above degree 0 have no part in it, and equal fingerprints do not prove that
    nothing was edited.
    """
    import numpy as np

    from mi_splat.maths.sh import dc_to_colour

    good = (arrays["scales"] > 0).all(1)
    for value in arrays.values():
        good &= np.isfinite(value).all(axis=tuple(range(1, value.ndim)))
    total = arrays["opacities"][good].sum(dtype=np.float64)
    if not total > 0:
        return ""
    numbers = np.split(np.flatnonzero(good), range(_CHUNK, int(good.sum()), _CHUNK))

    def parts() -> Iterator[list[NDArray[np.float64]]]:
        """A part of the Gaussians after the other, as sums of all at once take much
        memory.
        """
        for rows in numbers:
            means, scales, _, opacities, sh = (
                value[rows].astype(np.float64) for value in arrays.values()
            )
            yield [
                means,
                scales,
                opacities / total,
                opacities,
                dc_to_colour(sh[:, 0]).clip(0, 1),
            ]

    middle = sum(weight @ means for means, _, weight, *_ in parts())
    covariance = sum(
        ((means - middle) * weight[:, None]).T @ (means - middle)
        for means, _, weight, *_ in parts()
    )
    size = max(math.sqrt(np.trace(covariance)), 1e-30)
    sums = np.zeros((3, 8))
    for means, scales, weight, opacities, colours in parts():
        near = weight * np.exp(-np.linalg.norm(means - middle, axis=1) / size)
        spans = 1 + np.sort(np.log2(scales / size), axis=1) / 24
        columns = np.column_stack([np.ones(len(means)), spans, opacities, colours])
        sums += weight @ columns, weight @ columns**2, near @ columns
    middles, squares, nearest = sums[:, 1:]
    spreads = 2 * np.sqrt((squares - middles**2).clip(0))
    extents = np.sqrt(np.linalg.eigvalsh(covariance).clip(0)) / size
    count = math.log2(good.sum()) / 32
    share = sums[2, 0]
    values = [count, *extents, *middles, *spreads, share, *(nearest / share)]
    return bytes(
        round(255 * min(max(float(value), 0.0), 1.0)) for value in values
    ).hex()
