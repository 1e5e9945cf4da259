"""The transfer matrix: how often attacks on some detectors deceive another one, with intervals and the control."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from attacks.dagger.transfer.jobs import SUCCESS
from attacks.observe.look import look_rows
from attacks.observe.measures import of, transfer_measures, with_control
from attacks.observe.rates import Measure, count
from attacks.observe.rows import ATTACKED, frame_of
from attacks.rate import Rate

Record = Mapping[str, Any]

_RATES = ("targeted", "untargeted", "noise_targeted", "noise_untargeted")


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
        return {
            "sources": list(self.sources),
            "detector": self.detector,
            "white_box": self.white_box,
            "runs": self.runs,
            **{name: getattr(self, name).as_dict() for name in _RATES},
        }


def looked_rows(records: Sequence[Record]) -> pl.DataFrame:
    """What detectors reported, a row for each run, splat and detector.

    Args:
        records: Of the study: `job`, and `judged`, by detector what `AttackedObjects.seen` returns.
    """
    return frame_of(
        row
        for number, record in enumerate(records)
        for detector, look in record["judged"].items()
        for row in look_rows(
            {"attack": str(number), "sources": "+".join(record["job"]["sources"]), "detector": detector}, look
        )
    )


def cells(rows: pl.DataFrame) -> list[Cell]:
    """The matrix, one cell for each group of detectors attacked and each one that judges.

    Args:
        rows: From `looked_rows`.
    """
    measures = {**transfer_measures(SUCCESS), "runs": Measure(holds=pl.lit(value=True), given=of(ATTACKED))}
    counted = count(with_control(rows), {name: measures[name] for name in ("runs", *_RATES)}, ("sources", "detector"))
    return [
        Cell(sources=tuple(sources.split("+")), detector=detector, runs=rates.pop("runs").total, **rates)
        for (sources, detector), rates in counted.items()
    ]


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
