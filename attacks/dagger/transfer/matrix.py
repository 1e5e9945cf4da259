"""The transfer matrix: how often attacks on some detectors deceive another one, with intervals and the control."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from attacks.dagger.transfer.jobs import SUCCESS
from attacks.rate import Rate

Record = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """How often the attacks on some detectors deceive one detector, of the runs whose clean object it finds.

    Attributes:
        sources: The detectors attacked.
        detector: The one that judges.
        targeted: It reports the wanted class on the object.
        untargeted: It no longer reports the object's own class there.
        noise_targeted: The same as `targeted` for random noise of the attacks' sizes.
        noise_untargeted: The same as `untargeted` for it.
        runs: Number of attacks, also those whose clean object it does not find.
    """

    sources: tuple[str, ...]
    detector: str
    targeted: Rate
    untargeted: Rate
    noise_targeted: Rate
    noise_untargeted: Rate
    runs: int

    @property
    def white_box(self) -> bool:
        """Whether the detector that judges is among those attacked."""
        return self.detector in self.sources

    def as_dict(self) -> dict[str, Any]:
        """The cell as JSON can hold it."""
        names = ("targeted", "untargeted", "noise_targeted", "noise_untargeted")
        return {
            "sources": list(self.sources),
            "detector": self.detector,
            "white_box": self.white_box,
            "runs": self.runs,
            **{name: getattr(self, name).as_dict() for name in names},
        }


def cells(records: Sequence[Record]) -> list[Cell]:
    """The matrix, one cell for each group of detectors attacked and each one that judges."""
    groups: dict[tuple[tuple[str, ...], str], list[Record]] = {}
    for record in records:
        for detector, seen in record["judged"].items():
            groups.setdefault((tuple(record["job"]["sources"]), detector), []).append(seen)
    return [_cell(sources, detector, seen) for (sources, detector), seen in groups.items()]


def _cell(sources: tuple[str, ...], detector: str, seen: Sequence[Record]) -> Cell:
    return Cell(sources=sources, detector=detector, runs=len(seen), **aim_rates(seen, SUCCESS))


def aim_rates(looks: Sequence[Record], confidence: float) -> dict[str, Rate]:
    """How often attacks reach their aims, and noise of their sizes does, of the runs whose clean object is found.

    Args:
        looks: What `AttackedObjects.seen` returns, for each run.
        confidence: From which a class counts as reported.

    Returns:
        `targeted`, `untargeted`, `noise_targeted` and `noise_untargeted`, as in `Cell`.
    """

    def found(look: Record) -> bool:
        return clean_is_found(look, confidence)

    def targeted(kind: str) -> Rate:
        return Rate.of(looks, lambda look: bool(look[kind]["target"] >= confidence), given=found)

    def untargeted(kind: str) -> Rate:
        return Rate.of(looks, lambda look: bool(look[kind]["original"] < confidence), given=found)

    return {
        "targeted": targeted("attacked"),
        "untargeted": untargeted("attacked"),
        "noise_targeted": targeted("noise"),
        "noise_untargeted": untargeted("noise"),
    }


def clean_is_found(look: Record, confidence: float) -> bool:
    """Whether the clean object is reported, and not taken for the target."""
    return bool(look["clean"]["original"] >= confidence > look["clean"]["target"])


def left_out(matrix: Sequence[Cell]) -> list[dict[str, Any]]:
    """For each detector: the ensemble of all others against it, beside the best single one of them and the noise."""
    rows = []
    for cell in matrix:
        if len(cell.sources) < 2 or set(cell.sources) != set(attacked(matrix)) - {cell.detector}:
            continue
        singles = [
            one for one in matrix if len(one.sources) == 1 and one.detector == cell.detector and not one.white_box
        ]
        row: dict[str, Any] = {"detector": cell.detector, "ensemble": cell.as_dict()}
        for name in ("targeted", "untargeted"):
            best = max(singles, key=lambda one: getattr(one, name).fraction, default=None)
            row[f"best_single_{name}"] = None if best is None else best.as_dict()
        rows.append(row)
    return rows


def attack_rows(records: Sequence[Record]) -> list[dict[str, Any]]:
    """For each group of detectors attacked: how often it was deceived as a whole, and how far the pictures changed."""
    groups: dict[tuple[str, ...], list[Record]] = {}
    for record in records:
        groups.setdefault(tuple(record["job"]["sources"]), []).append(record["attack"])
    return [
        {
            "sources": list(sources),
            "all_deceived": Rate.of(found, lambda one: bool(one["success"])).as_dict(),
            "image_psnr": statistics.median(one["image_psnr"] for one in found),
            "steps": statistics.median(one["steps"] for one in found),
        }
        for sources, found in groups.items()
    ]


def attacked(matrix: Sequence[Cell]) -> list[str]:
    """Names of all detectors that were attacked, alone or with others."""
    return list(dict.fromkeys(name for cell in matrix for name in cell.sources))


def title(sources: Sequence[str], every: Sequence[str]) -> str:
    """What a row is called: the one detector attacked, or all but one of every one that was, or all names."""
    missing = [name for name in every if name not in sources]
    if len(sources) == 1:
        return sources[0]
    return f"all but {missing[0]}" if len(missing) == 1 and len(sources) > 1 else " + ".join(sources)


def noise(matrix: Sequence[Cell], detector: str, kind: str) -> Rate:
    """Over all attacks, how often random noise of their sizes does as well with a detector.

    Args:
        matrix: All cells.
        detector: The one that judges.
        kind: "targeted" or "untargeted".
    """
    rates = [getattr(cell, f"noise_{kind}") for cell in matrix if cell.detector == detector]
    return Rate(successes=sum(rate.successes for rate in rates), total=sum(rate.total for rate in rates))


def weights(records: Sequence[Record]) -> dict[str, list[str]]:
    """Fingerprints of the weights of every detector attacked, by its name; more than one if records are of several."""
    found: dict[str, list[str]] = {}
    for record in records:
        for one in record["attack"]["detectors"]:
            known = found.setdefault(one["detector"], [])
            if one["detector_fingerprint"] not in known:
                known.append(one["detector_fingerprint"])
    return found
