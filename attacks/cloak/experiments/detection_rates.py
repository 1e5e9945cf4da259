"""How often a study's object is reported: by elevation, by azimuth, and in the regions of its attacks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.experiments.view_reports import ViewReport, ViewReports
from attacks.rate import Rate

CONFIDENCES = (0.1, 0.3, 0.5)
"""From which a detection counts: 0.5 is the study's, 0.3 what many programs take, 0.1 shows what is nearly seen."""
BAND, SECTOR, LOW = 10.0, 30.0, 30.0
"""Degrees of elevation in a band, of azimuth in a sector, and of elevation below which a camera is a low one."""
ELSEWHERE = "outside of all triggers"


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Cameras whose rates are taken together.

    Attributes:
        kind: "elevation", "azimuth" or "region".
        name: Of the region; of the others, where the group begins and ends.
        low: Where it begins, degrees; 0 of a region.
        holds: Whether a camera is one of them.
    """

    kind: str
    name: str
    low: float
    holds: Callable[[ViewReport], bool]


def groups(study: StudyConfig) -> list[Group]:
    """Bands of elevation outside of attacks with an azimuth of their own, sectors of low cameras, and regions."""
    turned = [attack.name for attack in study.attack if attack.azimuth is not None]

    def band(low: float) -> Callable[[ViewReport], bool]:
        return lambda one: low <= one.elevation < low + BAND and all(one.depths[name] < 0 for name in turned)

    def sector(low: float) -> Callable[[ViewReport], bool]:
        return lambda one: low <= one.azimuth < low + SECTOR and one.elevation < LOW

    def region(name: str) -> Callable[[ViewReport], bool]:
        return lambda one: one.depths[name] >= 0

    bands = [BAND * number for number in range(int(90 / BAND))]
    sectors = [SECTOR * number for number in range(int(360 / SECTOR))]
    return [
        *(Group(kind="elevation", name=f"{low:g} to {low + BAND:g}", low=low, holds=band(low)) for low in bands),
        *(Group(kind="azimuth", name=f"{low:g} to {low + SECTOR:g}", low=low, holds=sector(low)) for low in sectors),
        *(Group(kind="region", name=one.name, low=0.0, holds=region(one.name)) for one in study.attack),
        Group(kind="region", name=ELSEWHERE, low=0.0, holds=lambda one: all(d < 0 for d in one.depths.values())),
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A rate, and what it is of.

    Attributes:
        group: Which cameras.
        detector: Which detector.
        pictures: "path traced", "clean" or "cloaked".
        seed: Of the splat; None: of all seeds together.
        reported: Field of `ViewReport` that counts, "own" or "target".
        confidence: From which it counts.
        rate: How often.
    """

    group: Group
    detector: str
    pictures: str
    seed: int | None
    reported: str
    confidence: float
    rate: Rate

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {
            "by": self.group.kind,
            "cameras": self.group.name,
            "detector": self.detector,
            "pictures": self.pictures,
            "seed": self.seed,
            "reported": self.reported,
            "confidence": self.confidence,
            **self.rate.as_dict(),
        }


def detection_rates(study: StudyConfig, found: Sequence[ViewReports]) -> list[Row]:
    """Every rate, of each seed and of all together; of groups in which there is a camera."""
    return [row for group in groups(study) for row in _rates(group, found) if row.rate.total]


def _rates(group: Group, found: Sequence[ViewReports]) -> Iterator[Row]:
    """The rates of one group."""
    together: dict[tuple[str, str], list[ViewReports]] = {}
    for one in found:
        together.setdefault((one.detector, one.pictures), []).append(one)
    for (detector, pictures), some in together.items():
        seeds: Mapping[int | None, Sequence[ViewReports]] = {
            None: some,
            **{one.seed: [one] for one in some if one.seed is not None},
        }
        for seed, series in seeds.items():
            here = [one for each in series for one in each.view_reports if group.holds(one)]
            for reported in ("own", "target"):
                for confidence in CONFIDENCES:
                    yield Row(
                        group=group,
                        detector=detector,
                        pictures=pictures,
                        seed=seed,
                        reported=reported,
                        confidence=confidence,
                        rate=Rate.of(here, lambda one: getattr(one, reported) >= confidence),  # noqa: B023  # at once
                    )


def chosen(
    rows: Sequence[Row], kind: str, *, detector: str, pictures: str, reported: str = "own", confidence: float = 0.5
) -> list[tuple[Group, Rate]]:
    """Groups of one kind, in their order, and their rates of all seeds together.

    Args:
        rows: From `detection_rates`.
        kind: Of the groups.
        detector: Which detector.
        pictures: Which pictures.
        reported: What counts.
        confidence: From which it counts.
    """
    wanted = (kind, detector, pictures, None, reported, confidence)
    return [
        (row.group, row.rate)
        for row in rows
        if (row.group.kind, row.detector, row.pictures, row.seed, row.reported, row.confidence) == wanted
    ]


def spread(rows: Sequence[Row], like: Row) -> list[Rate]:
    """The rates of single seeds that belong to a rate of all together."""
    same = (like.group, like.detector, like.pictures, like.reported, like.confidence)
    return [
        row.rate
        for row in rows
        if row.seed is not None and (row.group, row.detector, row.pictures, row.reported, row.confidence) == same
    ]


def hiding(study: StudyConfig) -> str | None:
    """Name of the region from which the study hides the object all around."""
    attack = setup.overhead(study)
    return None if attack is None else attack.name
