"""How often the attacks of a rendering study reach their aim, by attack and condition, with intervals and a control."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from attacks.observe.look import look_rows
from attacks.observe.measures import transfer_measures, with_control
from attacks.observe.rates import count
from attacks.observe.rows import ATTACKED, frame_of
from attacks.rate import Rate
from attacks.rendering_studies.config import OWN

Record = Mapping[str, Any]
"""`job` (a `StudyAttack` as JSON), `attack` (its summary) and `looks`, by condition what `StudyRunner.look` returns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Attacks that differ in what is attacked and in the seed only.

    Attributes:
        detector: The one attacked, which judges.
        renderer: Whose pictures the attacker looked at.
        gradient: Whose gradient the attacker followed.
        attribute: What was attacked.
        sh_degree: SH degree of the attacked file; None if SH did not change.
        norm: How the change is measured.
        eps: Radius of the ball.
    """

    detector: str
    renderer: str
    gradient: str
    attribute: str
    sh_degree: int | None
    norm: str
    eps: float

    @property
    def source(self) -> str:
        """Renderer, and whose gradient if it is another's."""
        return self.renderer if self.gradient == OWN else f"{self.renderer}, gradient of {self.gradient}"

    @property
    def ball(self) -> str:
        """Attribute, norm and radius."""
        bands = "" if self.sh_degree is None else f" of degree {self.sh_degree}"
        return f"{self.attribute}{bands}, {self.norm} {self.eps:g}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What a group of attacks does under one condition, of the runs whose clean object is found under it.

    Attributes:
        group: The attacks.
        condition: Name of the condition.
        found: How often the clean object is found, and not taken for the target.
        targeted: The wanted class is reported on the object.
        untargeted: The object's own class no longer is.
        noise_targeted: The same as `targeted` for random noise of the attacks' sizes.
        noise_untargeted: The same as `untargeted` for it.
        target_confidence: Median confidence in the wanted class after the attack, over all runs.
    """

    group: Group
    condition: str
    found: Rate
    targeted: Rate
    untargeted: Rate
    noise_targeted: Rate
    noise_untargeted: Rate
    target_confidence: float

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        group = self.group
        rates = ("found", "targeted", "untargeted", "noise_targeted", "noise_untargeted")
        return {
            **{name: getattr(group, name) for name in group.__dataclass_fields__},
            "condition": self.condition,
            "target_confidence": self.target_confidence,
            **{name: getattr(self, name).as_dict() for name in rates},
        }


def outcomes(records: Sequence[Record], *, confidence: float) -> list[Outcome]:
    """Every group of attacks under every condition, in the order of the records.

    Args:
        records: The study.
        confidence: From which a class counts as reported.
    """
    groups = list(dict.fromkeys(group_of(record) for record in records))
    rows = frame_of(
        row
        for number, record in enumerate(records)
        for condition, look in record["looks"].items()
        for row in look_rows(
            {"attack": str(number), "condition": condition, "detector": group_of(record).detector}, look
        )
    )
    group_numbers = {str(number): groups.index(group_of(record)) for number, record in enumerate(records)}
    rows = with_control(rows).with_columns(group=pl.col("attack").replace_strict(group_numbers))
    by = ("group", "condition")
    medians = rows.filter(splat=ATTACKED).group_by(by).agg(pl.col("target_score").median())
    target = {(group, condition): score for group, condition, score in medians.iter_rows()}
    return [
        Outcome(group=groups[group], condition=condition, target_confidence=target[group, condition], **rates)
        for (group, condition), rates in count(rows, transfer_measures(confidence), by).items()
    ]


def group_of(record: Record) -> Group:
    """The group that an attack belongs to."""
    job = record["job"]
    config = job["config"]
    return Group(
        detector=job["detector"],
        renderer=job["renderer"],
        gradient=job["gradient"],
        attribute=config["attributes"][0],
        sh_degree=config["sh_degree"] if config["attributes"][0] == "sh" else None,
        norm=config["norm"],
        eps=config["eps"][0],
    )


def image_psnr(records: Sequence[Record]) -> dict[Group, float]:
    """Median PSNR of the attacked to the clean picture in the attacker's renderer, dB, for each group."""
    found: dict[Group, list[float]] = {}
    for record in records:
        found.setdefault(group_of(record), []).append(record["attack"]["image_psnr"])
    return {group: statistics.median(values) for group, values in found.items()}
