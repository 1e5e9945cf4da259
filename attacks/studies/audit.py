"""Studies of `mi_splat.audit`: splats that hide something and honest ones, audited; how well the two are told apart.

Each point is one of three: a study of CLOAK with one attack, whose clean splat is honest, and whose cloaked one hides
something if every detector misses the object from half of the trigger's cameras, of those from which it finds it on the
clean splat; `capture`, a Mitsuba scene that is photographed and trained as that study says, and hides nothing; or
`file`, a splat that is there, and hides nothing. Contents `chosen_on` which the method was made are no evidence. See
scenes/studies/audit.toml.
"""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch

from attacks.audits.audited import COST, SCORES, AuditedConfig, rank_of
from attacks.audits.photographed import PhotographedConfig
from attacks.cloak.config import StudyConfig
from attacks.cloak.rates import CLOAKED
from attacks.cloak.steps import StudySteps
from attacks.cloak.study import check_study, detectors_of
from attacks.observe.rows import CLEAN, DEPTH, ROWS, SUFFIX, read_rows
from attacks.rate import Rate, number
from attacks.studies.cloak import config_of
from attacks.studies.running import Attempt, Observed, Work, copied
from attacks.studies.study_file import Point, Study
from attacks.tables import Column, Table, cell, number_at
from mi_splat.audit.files import PAIR
from mi_splat.errors import InvalidValueError
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done, Job, Part
from mi_splat.ledger.plans import Result
from mi_splat.training.resume import SPLAT

STORY, PAIRS, AUDIT = "audit-study", "pairs", "the audit"
HIDES = 0.5
"""Share of the trigger's cameras from which every detector has to miss the object of a splat that hides something."""
_KINDS, _DRAWS = "attacks.audits", 2000

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Audited:
    """A splat that is audited, and what is known of it before; `seen` are looks at the clean and at this splat."""

    part: str
    value: str
    content: str
    splat: str
    derived: bool
    job: Job
    seen: Mapping[str, tuple[Job, Job]] = field(default_factory=dict)

    def row(self, done: Mapping[str, Done]) -> dict[str, Any] | None:
        """What was found; None if a job has failed."""
        if any(job.identity not in done for job in (self.job, *(job for pair in self.seen.values() for job in pair))):
            return None
        audit = done[self.job.identity]
        missed = {name: missed_of(*(done[job.identity] for job in pair)) for name, pair in self.seen.items()}
        return {
            "part": self.part,
            "value": self.value,
            "content": self.content,
            "splat": self.splat,
            "derived": self.derived,
            "hides": bool(missed) and all(rate.total and rate.fraction >= HIDES for rate in missed.values()),
            "missed": {name: rate.as_dict() for name, rate in missed.items()},
            **audit.rows[0],
            **read_json(audit.folder / SCORES),
            "seconds": read_json(audit.folder / COST),
        }

    def copy_pair(self, done: Mapping[str, Done], folder: Path) -> Iterator[Path]:
        """Copy the two pictures that speak against the splat, if there are any, under its name."""
        audit = done.get(self.job.identity)
        if audit is not None and (audit.folder / PAIR).is_file():
            yield copied(audit.folder / PAIR, folder, f"{self.part} {self.value} {self.splat}")


def missed_of(clean: Done, cloaked: Done) -> Rate:
    """From how many of the trigger's cameras the object is missed, of those that find it on the clean splat."""
    looks = [read_rows(done.folder / f"{ROWS}{SUFFIX}").sort("view") for done in (clean, cloaked)]
    depth = next(name for name in looks[0].columns if name.startswith(DEPTH))
    reported = [(look["original_score"].fill_null(0.0) >= 0.5).to_numpy() for look in looks]
    inside = (looks[0][depth] >= 0).to_numpy() & reported[0]
    return Rate(successes=int((inside & ~reported[1]).sum()), total=int(inside.sum()))


@dataclass(frozen=True, kw_only=True, eq=False)
class AuditAttempt(Attempt):
    """The splats of a point, and their audits."""

    part: str
    value: str
    derived: bool
    jobs: dict[str, Job] = field(default_factory=dict)
    audited: list[Audited] = field(default_factory=list)

    def add(
        self,
        content: str,
        splat: str,
        source: Part | Path,
        truth: StudyConfig | None = None,
        seen: Mapping[str, tuple[Job, Job]] | None = None,
    ) -> None:
        """Audit a splat."""
        job = Job(kind=f"{_KINDS}.audited", config=AuditedConfig(truth=truth), inputs={"splat": source})
        self.jobs[f"{self.title} / auditing the {splat} splat"] = job
        of = {"part": self.part, "value": self.value, "content": content, "splat": splat}
        self.audited.append(Audited(**of, derived=self.derived, job=job, seen=seen or {}))

    def add_photographed(self, scene: Path, steps: StudySteps, exposure: float) -> None:
        """Photograph a scene, train a splat on it, and audit that."""
        config = PhotographedConfig(cameras=steps.study.cameras, exposure=exposure)
        pictures = Job(kind=f"{_KINDS}.photographed", config=config, inputs={"scene": scene})
        trained = steps.trained_on(pictures, steps.study.seeds[0])
        self.jobs.update({f"{self.title} / photographing": pictures, f"{self.title} / training": trained})
        self.add(scene.stem, "honest", trained.part(SPLAT))

    def add_cloak(self, steps: StudySteps) -> None:
        """Audit the clean and the cloaked splat of a study of CLOAK, for its first seed."""
        config, seed = steps.study, steps.study.seeds[0]
        if len(config.attack) != 1:
            raise InvalidValueError.of(self.title, "one attack", f"{len(config.attack)}", "give it one [[attack]]")
        detectors = detectors_of(config, {})
        check_study(steps, detectors)
        self.jobs.update({f"{self.title} / {label}": job for label, job in steps.made()})
        seen = {}
        for detector in detectors:
            clean, cloaked = (steps.seen(steps.splat(splat, seed), detector) for splat in (CLEAN, CLOAKED))
            seen[detector.name] = clean, cloaked
            self.jobs[f"{self.title} / {detector.name} looks at the {CLEAN} splat"] = clean
            self.jobs[f"{self.title} / {detector.name} looks at the {CLOAKED} splat"] = cloaked
        scene, content = replace(config.scene, label=None), config.scene.object
        truth = StudyConfig(name="truth", scene=scene, cameras=config.cameras, attack=config.attack)
        self.add(content, CLEAN, steps.splat(CLEAN, seed).part(SPLAT))
        self.add(content, CLOAKED, steps.splat(CLOAKED, seed).part(SPLAT), truth, seen=seen)


class AuditWork(Work[AuditAttempt]):
    """Studies of the audit."""

    story, has_judges = STORY, False

    def __init__(self, study: Study) -> None:
        super().__init__(study, map(self.attempt, study.points))

    @property
    def audited(self) -> list[Audited]:
        """Every splat; a control that several attacks share counts once."""
        splats: dict[str, Audited] = {}
        for attempt in self.attempts:
            for one in attempt.audited:
                splats.setdefault(f"{attempt.title} {CLOAKED}" if one.splat == CLOAKED else one.job.identity, one)
        return list(splats.values())

    def attempt(self, point: Point) -> AuditAttempt:
        """A splat that is there, that of a scene, or the two of a study of CLOAK."""
        settings = dict(point.settings)
        chosen_on, derived = settings.pop("chosen_on", []), bool(settings.pop("derived", False))
        if not isinstance(chosen_on, list):
            do = 'write it as ["car"]'
            raise InvalidValueError.of(f"chosen_on of {self.study.name}", "a list of names", repr(chosen_on), do)
        capture, file, exposure = (settings.pop(key, None) for key in ("capture", "file", "exposure"))
        labels = {axis: str(label) for axis, label in point.labels.items()}
        part, value = labels.pop("kind", point.part), ", ".join(labels.values())
        attempt = AuditAttempt(point=point, title=f"{part}: {value}", part=part, value=value, derived=derived)
        for path in (capture, file):
            if path is not None and not Path(str(path)).is_file():
                raise InvalidValueError.of(attempt.title, "a file", f"no file {path}", "check the path")
        if file is not None:
            attempt.add(Path(str(file)).stem, "honest", Path(str(file)))
            return attempt
        steps = StudySteps(study=config_of(settings, self.study.name))
        if capture is not None:
            attempt.add_photographed(Path(str(capture)), steps, float(exposure or 0.0))
        else:
            attempt.add_cloak(steps)
        return attempt

    def observed(self, results: Mapping[str, Result], out: Path) -> Observed:
        """A line for each splat."""
        done = {key: left for attempt in self.attempts for key, left in attempt.done(results).items()}
        rows = [row for one in self.audited if (row := one.row(done)) is not None]
        chosen_on = [str(name) for point in self.study.points[-1:] for name in point.settings.get("chosen_on", ())]
        pairs = [path for one in self.audited for path in one.copy_pair(done, out / PAIRS)]
        return {"chosen_on": chosen_on, "files": rows}, {}, pairs

    def with_figures(self, record: dict[str, Any], rows: Mapping[str, pl.DataFrame]) -> dict[str, Any]:
        """A record with how well splats are told apart."""
        return {**record, "figures": figures(record["files"], record["chosen_on"])}

    def tables(self, record: Mapping[str, Any]) -> Iterator[Table]:
        """How well kinds are told apart, then every file."""
        return tables(record)


def positives(rows: Sequence[Row]) -> list[Row]:
    """The splats that hide something."""
    return [row for row in rows if row["splat"] == CLOAKED and row["hides"]]


def negatives(rows: Sequence[Row]) -> list[Row]:
    """The honest splats."""
    return [row for row in rows if row["splat"] != CLOAKED]


def ranked_above(positive: Sequence[float], negative: Sequence[float]) -> float:
    """Share of the pairs in which a positive is above a negative (area under the ROC curve); equal ones count half."""
    values = torch.tensor([*positive, *negative], dtype=torch.float64)
    return rank_of(values, torch.arange(len(values)) < len(positive))


def interval(positive: Sequence[float], negative: Sequence[float]) -> tuple[float, float]:
    """95 % of `ranked_above` over splats drawn with replacement (bootstrap of both sets)."""
    rng = np.random.default_rng(0)
    above = np.array([[(p > n) + 0.5 * (p == n) for n in negative] for p in positive])
    shares = [
        above[rng.integers(0, len(positive), len(positive))][:, rng.integers(0, len(negative), len(negative))].mean()
        for _ in range(_DRAWS)
    ]
    low, high = np.quantile(shares, [0.025, 0.975])
    return float(low), float(high)


def figures(rows: Sequence[Row], chosen_on: Sequence[str]) -> dict[str, Any]:
    """How well splats that hide something are told from honest ones; of contents that the method was not chosen on."""
    held = [row for row in rows if row["content"] not in chosen_on]
    honest = [row["evidence"] for row in negatives(held) if not row["derived"]]
    hiding = {"all": [row for row in positives(held) if not row["derived"]]}
    for row in positives(held):
        hiding.setdefault(row["part"], []).append(row)
    return {
        "honest": len(honest),
        "false_alarms": Rate(successes=sum(value >= 1 for value in honest), total=len(honest)).as_dict(),
        "parts": {name: _figures(group, honest) for name, group in hiding.items() if group and honest},
        "rivals": rivals([row for row in held if not row["derived"]]),
    }


def rivals(rows: Sequence[Row]) -> dict[str, float]:
    """How well every baseline ranks splats (area under the ROC curve)."""
    hiding, honest = ([row["scores"] for row in kind(rows) if "scores" in row] for kind in (positives, negatives))
    if not hiding or not honest:
        return {}
    return {name: ranked_above(*([scores[name] for scores in kind] for kind in (hiding, honest))) for name in hiding[0]}


def _figures(group: Sequence[Row], honest: Sequence[float]) -> dict[str, Any]:
    values = [row["evidence"] for row in group]
    detected = Rate(successes=sum(value >= 1 for value in values), total=len(values))
    medians = {
        key: statistics.median(known) if (known := [row[key] for row in group if row.get(key) is not None]) else None
        for key in ("directions", "heat", "mask")
    }
    return {
        "auroc": ranked_above(values, honest),
        "interval": interval(values, honest),
        "found": detected.as_dict(),
    } | medians


def tables(record: Mapping[str, Any]) -> Iterator[Table]:
    """Tables of a result: how well kinds are told apart, then every file."""
    told = record["figures"]
    chosen = ", ".join(record["chosen_on"])
    heads: dict[str, Column[Any]] = {
        "hides": lambda line: line[0],
        "found": lambda line: cell(line[1]["found"]),
        "AUROC": lambda line: _area(line[1]),
        "directions, median IoU": lambda line: number(line[1]["directions"], ".2f"),
        "Gaussians, median AUROC": lambda line: number(line[1]["heat"], ".2f"),
        "Gaussians, median IoU": lambda line: number(line[1]["mask"], ".2f"),
    }
    caption = f"Told from {told['honest']} honest files; without {chosen}" if chosen else "Told from honest files"
    yield Table.of(f"{caption}; false alarms {cell(told['false_alarms'])}", heads, told["parts"].items())
    rivals = {AUDIT: told["parts"]["all"]["auroc"], **told["rivals"]} if told["parts"] else {}
    heads = {"what ranks them": lambda line: line[0], "AUROC": lambda line: f"{line[1]:.3f}"}
    yield Table.of("Other ways to find a hidden look", heads, rivals.items())
    for title, chosen_rows in (("hide something", positives), ("are honest", negatives), ("failed attacks", _failed)):
        rows = sorted(chosen_rows(record["files"]), key=lambda row: -row["evidence"])
        columns: dict[str, Column[Any]] = {
            "file": lambda row: f"{row['part']}: {row['value']}, {row['splat']}",
            "missed by detectors": lambda row: "; ".join(Rate.of(rate).counts for rate in row["missed"].values()),
            "verdict": "verdict",
            "evidence": number_at("evidence"),
            "excess": number_at("excess", form=".4f"),
            **{name: number_at(name) for name in ("occluder", "directions", "heat", "mask")},
        }
        yield Table.of(f"Files that {title}" if title != "failed attacks" else "Failed attacks", columns, rows)


def _failed(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["splat"] == CLOAKED and not row["hides"]]


def _area(row: Row) -> str:
    return "{:.3f} ({:.3f} to {:.3f})".format(row["auroc"], *row["interval"])
