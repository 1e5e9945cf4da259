"""Studies of CLOAK with one thing changed at a time: how much of the attack depends on
it, as tables.

The settings of `study = "cloak"` are those of a file that `mi-splat cloak` reads;
`base` names such a file, and what the study says comes in the place of what stands
there. Every point is done with all of its seeds. An axis is a chart.
"""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import polars as pl

from attacks.cloak.config import StudyConfig, check_files
from attacks.cloak.kinds.seen import loaded
from attacks.cloak.rates import LOOKS, OWN_REGION, over_objects
from attacks.cloak.steps import ROW_NAMES, Look, StudySteps
from attacks.cloak.study import check_study, detectors_of, observed, write_report
from attacks.cloak.tables import RULE, in_words, spread_of
from attacks.detectors.base import Detector
from attacks.observe.conditions import OWN, SunTable
from attacks.observe.rows import ROWS, by_camera
from attacks.studies.attack import street_of
from attacks.studies.running import Attempt, Observed, Work, check_apart, names_of
from attacks.studies.study_file import Point, Settings, Study, merged, with_none
from attacks.tables import Column, Table, cell, number_at
from mi_splat.errors import InvalidValueError
from mi_splat.fields import at_least, check, decode
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger import Done
from mi_splat.ledger.plans import Result

STORY = "cloak-study"

RATES = {
    "control_recall": "control found",
    "trigger_miss_rate": "cloaked missed",
    "nothing_reported": "nothing of any class reported",
    "benign_recall": "cloaked found elsewhere",
    "target_rate": "target class",
}
"""Rates of a summary that a table has, and their heads."""

_POOLED = {**RATES, "trigger_miss_rate_all": "cloaked missed, all inside"}


def tables(groups: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Iterator[Table]:
    """For each group a table of rates, one of what is lost, and one of what is seen
    under other conditions.

    Rates are pooled over seeds, as a summary has them. Losses, and the numbers of
    Gaussians, are means over the seeds; the transition is that of all seeds together.
    """
    for group, results in groups.items():
        title = group.replace("_", " ")
        summaries = [{"value": value, **summary} for value, summary in results.items()]
        looked = [
            {"value": summary["value"], "detector": name, "study": summary, **rates}
            for summary in summaries
            for name, rates in summary["by_detector"].items()
        ]
        columns: dict[str, Column[Any]] = {title: "value", "detector": "detector"}
        columns |= {
            head: lambda line, key=key: (
                cell(line.get(key)) + spread_of(line["study"], line["detector"], key)
            )  # type: ignore[misc]
            for key, head in RATES.items()
        }
        yield Table.of(f"By {title}", columns, looked)
        yield Table.of(
            f"By {title}: what is lost", {title: "value", **_COSTS}, summaries
        )
        under = [
            {"value": summary["value"], **look}
            for summary in summaries
            for look in summary.get("looks", ())
        ]
        if under:
            heads: dict[str, Column[Any]] = {
                title: "value",
                "condition": "condition",
                "detector": "detector",
            }
            heads |= {
                head: name
                for name, head in LOOKS.items()
                if any(name in look for look in under)
            }
            heads |= {
                f"PSNR, dB: {head}": number_at("psnr", name, form=".1f")
                for name, head in _PICTURES.items()
                if any(look["psnr"].get(name) is not None for look in under)
            }
            yield Table.of(f"By {title}: under other conditions", heads, under)


def _gaussians(which: str) -> Column[Any]:
    return lambda line: f"{statistics.mean(line['gaussians'][which]):,.0f}"


_COSTS: dict[str, Column[Any]] = {
    "seeds": lambda line: len(line["seeds"]),
    "transition, degrees": number_at("transition_degrees", form=".1f"),
    "clean far from the triggers, dB": number_at("benign_psnr", "clean"),
    "dB lost there": number_at("benign_psnr_drop"),
    "dB lost beside the object": number_at("stealth", "surroundings_psnr_drop"),
    "dB lost on the object beside a trigger": number_at("stealth", "object_psnr_drop"),
    "stealthy": lambda line: line["stealth"] and line["stealth"]["stealthy"],
    "Gaussians, clean": _gaussians("clean"),
    "Gaussians, cloaked": _gaussians("cloaked"),
}
_PICTURES = {
    "missed_cloaked": "cloaked, well inside",
    "found_cloaked": "cloaked, outside",
    "missed_clean": "control, well inside",
    "found_clean": "control, outside",
}
"""Which pictures are compared with those that the victim sees."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloakJudge:
    """Who else looks at the splats of a point, and how."""

    detector: str | None = None  # None is each of the study's
    condition: str = ""  # see `attacks.observe.conditions`
    # every N-th held-out camera is used
    every: Annotated[int, at_least(1, "cameras")] = 4
    sun: SunTable | None = None  # a street of meshes for conditions that are hours

    def __post_init__(self) -> None:
        check(self)

    def looks(self, steps: StudySteps, detectors: Sequence[Detector]) -> Iterator[Look]:
        """The looks at each splat of a study."""
        sun, street = street_of(self.condition, self.sun)
        if sun is not None and steps.study.layers is None:
            do = (
                "take a study with [layers], whose object is known Gaussian by Gaussian"
            )
            raise InvalidValueError.of(
                f"study under the condition {self.condition}", "layers", "none", do
            )
        shown = self.condition or OWN
        for splat, seed in steps.names():
            for detector in (
                detectors if self.detector is None else [loaded(self.detector)]
            ):
                how = {"condition": self.condition, "every": self.every, "sun": sun}
                job = steps.seen(steps.splat(splat, seed), detector, **how, **street)  # type: ignore[arg-type]
                label = (
                    f"{detector.name} looks at the {splat} splat, seed {seed}, {shown}"
                )
                yield Look(
                    label=label,
                    job=job,
                    splat=ROW_NAMES[splat],
                    seed=seed,
                    condition=shown,
                )


@dataclass(frozen=True, kw_only=True, eq=False)
class CloakAttempt(Attempt):
    """One study of CLOAK with its values."""

    part: str
    value: str
    steps: StudySteps
    detectors: Sequence[Detector]
    looks: Sequence[Look] = ()


class CloakWork(Work[CloakAttempt]):
    """Studies of CLOAK, which have no single objective to bisect for."""

    story = STORY

    def __init__(self, study: Study, weights: Mapping[str, Path] | None = None) -> None:
        self.weights = weights or {}
        super().__init__(study, map(self.attempt, study.points))

    def attempt(self, point: Point) -> CloakAttempt:
        """A study of CLOAK, and further looks at its splats."""
        config = config_of(point.settings, self.study.name)
        detectors = detectors_of(config, self.weights)
        steps = StudySteps(study=config, weights=self.weights)
        check_study(steps, detectors)
        where = f"{self.study.name}, judge"
        judges = [
            decode(CloakJudge, with_none(judge.settings), where)
            for judge in self.study.judges
        ]
        looks = [look for judge in judges for look in judge.looks(steps, detectors)]
        check_apart(where, (look.label for look in looks))
        part, value = names_of(point, self.study.name)
        title = f"{part}: {value}"
        jobs = {
            **dict(steps.made()),
            **{look.label: look.job for look in (*steps.looked(detectors), *looks)},
        }
        return CloakAttempt(
            point=point,
            title=title,
            jobs={f"{title} / {label}": job for label, job in jobs.items()},
            part=part,
            value=value,
            steps=steps,
            detectors=detectors,
            looks=looks,
        )

    def observed(self, results: Mapping[str, Result], out: Path) -> Observed:
        """What is seen at each point."""
        points = dict[str, dict[str, Any]]()
        frames = dict[str, list[pl.DataFrame]]()
        for attempt in self.attempts:
            done = attempt.done(results)
            if attempt.is_done(done):
                points[attempt.title], tables_of = _seen(attempt, done)
                for name, table in tables_of.items():
                    titled = by_camera(table).with_columns(attack=pl.lit(attempt.title))
                    frames.setdefault(name, []).append(titled)
        return (
            {"points": points},
            {name: pl.concat(parts, how="diagonal") for name, parts in frames.items()},
            [],
        )

    def with_figures(
        self, record: dict[str, Any], rows: Mapping[str, pl.DataFrame]
    ) -> dict[str, Any]:
        """A record with the rates of its parts; its points have theirs."""
        studies = {attempt.title: attempt.steps.study for attempt in self.attempts}
        return {
            **record,
            **(
                pooled(record["points"], studies, rows[ROWS])
                if record["points"]
                else {}
            ),
        }

    def tables(self, record: Mapping[str, Any]) -> Iterator[Table]:
        """The tables of each part."""
        yield from tables(by_part(record))
        yield from pooled_tables(record)


class CloakReport(CloakWork):
    """One study of CLOAK whose result has its splats and pictures, too: what
    `mi-splat cloak` does.
    """

    def write(self, results: Mapping[str, Result], out: Path) -> list[Path]:
        """Write the report of the study."""
        (attempt,) = self.attempts
        done = attempt.done(results)
        if not attempt.is_done(done):
            return []
        summary = write_report(attempt.steps, done, attempt.detectors, out)
        return [out / name for name in (*summary["files"], RECORD)]


def config_of(settings: Settings, name: str) -> StudyConfig:
    """The study of CLOAK of a point."""
    values = {key: value for key, value in settings.items() if key != "base"}
    if "base" in settings:
        path = Path(str(settings["base"]))
        if not path.is_file():
            raise InvalidValueError.of(
                f"base of {name}", "a TOML file", f"no file {path}", "check the path"
            )
        values = merged(
            DocumentReader(expected="a TOML file", do="correct it").read_toml(path),
            values,
        )
    study = decode(StudyConfig, {**with_none(values), "name": name}, name)
    check_files(study)
    return study


def _seen(
    attempt: CloakAttempt, done: Mapping[str, Done]
) -> tuple[dict[str, Any], dict[str, pl.DataFrame]]:
    """What was found at a point, as JSON can hold it, and its tables."""
    entry, tables = observed(attempt.steps, done, attempt.detectors, attempt.looks)
    judges = {
        look.job.config.detector: look.job.config.fingerprint for look in attempt.looks
    }
    named = {"part": attempt.part, "value": attempt.value}
    return {**named, **entry, "detectors": entry["detectors"] | judges}, tables


def pooled(
    points: Mapping[str, Mapping[str, Any]],
    studies: Mapping[str, StudyConfig],
    rows: pl.DataFrame,
) -> dict[str, Any]:
    """What a result says of each part whose points are one attack on several objects
    (`over_objects`), if any is.
    """
    parts: dict[str, dict[str, StudyConfig]] = {}
    for title, point in points.items():
        parts.setdefault(point["part"], {})[title] = studies[title]
    over = {part: over_objects(of_part, rows) for part, of_part in parts.items()}
    told = {part: rates for part, rates in over.items() if rates is not None}
    if told:
        return {"pooled": told}
    return {}


def pooled_tables(record: Mapping[str, Any]) -> Iterator[Table]:
    """For each part that is one attack on several objects a table of its rates over all
    of them.
    """
    columns: dict[str, Column[Any]] = {"detector": "detector", "its region": "region"}
    columns |= {
        head: lambda line, key=key: cell(line[key])  # type: ignore[misc]
        for key, head in _POOLED.items()
    }
    for part, over in record.get("pooled", {}).items():
        caption = (
            f"{part.replace('_', ' ')}: {over['objects']} objects together; intervals"
            " have objects drawn anew"
        )
        caption = caption[0].upper() + caption[1:]
        lines = [
            {"detector": name, "region": "all", **rates}
            for name, rates in over["by_detector"].items()
        ]
        yield Table.of(caption, columns, lines)
        lines = [
            {"detector": name, "region": in_words(own["bands"]), **own["rates"]}
            for name, own in over[OWN_REGION].items()
        ]
        yield Table.of(
            f"{caption}; each detector in its own region: {RULE}", columns, lines
        )


def by_part(record: Mapping[str, Any]) -> dict[str, dict[str, Mapping[str, Any]]]:
    """What was found, by part and value."""
    groups: dict[str, dict[str, Mapping[str, Any]]] = {}
    for point in record["points"].values():
        groups.setdefault(point["part"], {})[point["value"]] = point
    return groups
