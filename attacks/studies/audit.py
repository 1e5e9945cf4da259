"""Studies of `mi_splat.audit`: splats that hide something and honest ones, audited; how well the two are told apart.

Each point is one of three:

- a study of CLOAK with one attack: its clean splat is honest, and its cloaked one hides something if every detector
  misses the object from half of the trigger's cameras, of those from which it finds it on the clean splat;
- `capture`, a Mitsuba scene that is photographed and trained as that study says, and hides nothing;
- `file`, a splat that is there, and hides nothing.

    study = "audit"
    base = "scenes/audit_base.toml"
    chosen_on = ["car", "suitcase"]         # objects on which the method was chosen; the others are evidence

    [[case]]
    name = "overhead"
    matrix = { "scene.object" = ["car", "elephant"] }

    [[case]]
    name = "shiny"
    matrix = { capture = ["scenes/honest/mirror_ball.xml"] }
"""

import re
import shutil
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.audits.audited import AuditedConfig, rank_of
from attacks.audits.learnt import fit_attributes
from attacks.audits.photographed import PhotographedConfig
from attacks.audits.rivals import COST, RIVALS, RivalsConfig
from attacks.cloak.config import StudyConfig
from attacks.cloak.rates import CLOAKED
from attacks.cloak.steps import StudySteps
from attacks.cloak.study import check_study, detectors_of
from attacks.observe.rows import CLEAN, DEPTH, ROWS, SUFFIX, read_rows
from attacks.rate import Rate
from attacks.studies.cloak import config_of
from attacks.studies.plan import Work, write_study
from attacks.studies.study_file import Point, Study
from attacks.tables import Column, Table, cell, sections
from mi_splat import provenance
from mi_splat.audit.files import PAIR
from mi_splat.errors import InvalidValueError
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done, Job
from mi_splat.ledger.plans import Result
from mi_splat.training.resume import SPLAT

STORY, PAIRS = "audit-study", "pairs"
HIDES = 0.5
"""Share of the trigger's cameras from which every detector has to miss the object of a splat that hides something."""
_KINDS = "attacks.audits"
_DRAWS = 2000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Audited:
    """A splat and what is done with it."""

    part: str
    value: str
    content: str
    splat: str
    audit: Job
    rivals: Job
    derived: bool
    seen: Mapping[str, tuple[Job, Job]]

    def row(self, results: Mapping[str, Done]) -> dict[str, Any] | None:
        """What was found; None if a job has failed."""
        audit, rivals = results.get(self.audit.identity), results.get(self.rivals.identity)
        looks = {name: [results.get(job.identity) for job in pair] for name, pair in self.seen.items()}
        if audit is None or rivals is None or any(done is None for pair in looks.values() for done in pair):
            return None
        missed = {name: missed_of(pair[0], pair[1]) for name, pair in looks.items()}  # type: ignore[arg-type]
        hides = bool(missed) and all(rate.total and rate.successes >= HIDES * rate.total for rate in missed.values())
        told: dict[str, Any] = {"part": self.part, "value": self.value, "content": self.content, "splat": self.splat}
        told |= {"derived": self.derived, "hides": hides}
        told["missed"] = {name: rate.as_dict() for name, rate in missed.items()}
        seconds = {"the audit": read_json(audit.folder / COST)["seconds"], **read_json(rivals.folder / COST)["seconds"]}
        return {**told, **audit.rows[0], **read_json(rivals.folder / RIVALS), "seconds": seconds}

    def copy_pair(self, results: Mapping[str, Done], folder: Path) -> Path | None:
        """Copy the two pictures that speak against the splat, if there are any, under its name."""
        done = results.get(self.audit.identity)
        if done is None or not (done.folder / PAIR).is_file():
            return None
        name = re.sub(r"[^0-9A-Za-z.]+", "-", f"{self.part} {self.value} {self.splat}")
        folder.mkdir(exist_ok=True)
        return Path(shutil.copyfile(done.folder / PAIR, folder / f"{name}.png"))


def missed_of(clean: Done, cloaked: Done) -> Rate:
    """From how many of the trigger's cameras the object is missed, of those that find it on the clean splat."""
    looks = [read_rows(done.folder / f"{ROWS}{SUFFIX}").sort("view") for done in (clean, cloaked)]
    depth = next(name for name in looks[0].columns if name.startswith(DEPTH))
    reported = [(look["original_score"].fill_null(0.0) >= 0.5).to_numpy() for look in looks]
    asked = (looks[0][depth] >= 0).to_numpy() & reported[0]
    return Rate(successes=int((asked & ~reported[1]).sum()), total=int(asked.sum()))


class AuditWork(Work):
    """The jobs of a study of the audit.

    Raises:
        MiSplatError: A setting cannot be, or a detector cannot be loaded; before any job is done.
    """

    def __init__(self, study: Study) -> None:
        self.study = study
        self.chosen_on: tuple[str, ...] = ()
        self.audited: list[Audited] = []
        self._derived = False
        self.labels: dict[str, Job] = {}
        for point in study.points:
            self._add(point)

    def jobs(self) -> dict[str, Job]:
        """As in `Work`."""
        return self.labels

    def _add(self, point: Point) -> None:
        settings = dict(point.settings)
        chosen_on = settings.pop("chosen_on", [])
        if not isinstance(chosen_on, list):
            do = 'write it as ["car"]'
            raise InvalidValueError.of(f"chosen_on of {self.study.name}", "a list of names", repr(chosen_on), do)
        self.chosen_on = tuple(chosen_on)
        self._derived = bool(settings.pop("derived", False))
        capture, file, exposure = (settings.pop(key, None) for key in ("capture", "file", "exposure"))
        labels = {axis: str(label) for axis, label in point.labels.items()}
        part, value = labels.pop("kind", point.part), ", ".join(labels.values())
        title = f"{part}: {value}"
        for path in (capture, file):
            if path is not None and not Path(str(path)).is_file():
                raise InvalidValueError.of(title, "a file", f"no file {path}", "check the path")
        if file is not None:
            self._splat(part, value, Path(str(file)).stem, "honest", Path(str(file)))
            return
        config = config_of(settings, self.study.name)
        steps = StudySteps(study=config)
        if capture is not None:
            photographed = PhotographedConfig(cameras=config.cameras, exposure=float(exposure or 0.0))
            pictures = Job(kind=f"{_KINDS}.photographed", config=photographed, inputs={"scene": Path(str(capture))})
            trained = steps.trained_on(pictures, config.seeds[0])
            self.labels |= {f"{title} / photographing": pictures, f"{title} / training": trained}
            self._splat(part, value, Path(str(capture)).stem, "honest", trained.part(SPLAT))
            return
        if len(config.attack) != 1:
            raise InvalidValueError.of(title, "one attack", f"{len(config.attack)}", "give it one [[attack]]")
        self._cloak(part, value, steps)

    def _cloak(self, part: str, value: str, steps: StudySteps) -> None:
        """The clean and the cloaked splat of a study, for its first seed."""
        config = steps.study
        detectors, seed = detectors_of(config, {}), config.seeds[0]
        check_study(config, detectors)
        self.labels |= {f"{part}: {value} / {label}": job for label, job in steps.made()}
        seen = {}
        for detector in detectors:
            pair = tuple(steps.seen(steps.splat(splat, seed), detector) for splat in (CLEAN, CLOAKED))
            seen[detector.name] = (pair[0], pair[1])
            for splat, job in zip((CLEAN, CLOAKED), pair, strict=True):
                self.labels[f"{part}: {value} / {detector.name} looks at the {splat} splat"] = job
        truth = StudyConfig(
            name="truth", scene=replace(config.scene, label=None), cameras=config.cameras, attack=config.attack
        )
        content = config.scene.object
        self._splat(part, value, content, CLEAN, steps.splat(CLEAN, seed).part(SPLAT))
        self._splat(part, value, content, CLOAKED, steps.splat(CLOAKED, seed).part(SPLAT), truth=truth, seen=seen)

    def _splat(
        self,
        part: str,
        value: str,
        content: str,
        splat: str,
        source: Any,
        *,
        truth: StudyConfig | None = None,
        seen: Mapping[str, tuple[Job, Job]] | None = None,
    ) -> None:
        job = Job(kind=f"{_KINDS}.audited", config=AuditedConfig(truth=truth), inputs={"splat": source})
        rivals = Job(kind=f"{_KINDS}.rivals", config=RivalsConfig(), inputs={"splat": source})
        if splat != CLOAKED and any(audited.audit.identity == job.identity for audited in self.audited):
            return  # a control that several attacks share counts once
        self.labels[f"{part}: {value} / auditing the {splat} splat"] = job
        self.labels[f"{part}: {value} / asking rivals of the audit about the {splat} splat"] = rivals
        named = {"part": part, "value": value, "content": content, "splat": splat}
        self.audited.append(Audited(**named, audit=job, rivals=rivals, derived=self._derived, seen=seen or {}))

    def write(self, results: Mapping[str, Result], out: Path) -> list[Path]:
        """As in `Work`."""
        done = {
            job.identity: result for label, job in self.labels.items() if isinstance(result := results.get(label), Done)
        }
        rows = [row for audited in self.audited if (row := audited.row(done)) is not None]
        pairs = [path for audited in self.audited if (path := audited.copy_pair(done, out / PAIRS)) is not None]
        files = [{key: value for key, value in row.items() if key != "attributes"} for row in rows]
        record = {
            "story": STORY,
            **self.study.named,
            "chosen_on": list(self.chosen_on),
            "files": files,
            **provenance.origin(),
        }
        record["figures"] = figures(rows, self.chosen_on)
        return [*pairs, *write_study(self.study, record, sections(tables(record)), {}, out)]


Row = Mapping[str, Any]


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
        "rivals": rivals_of(rows, chosen_on) if hiding["all"] and honest else {},
    }


def rivals_of(rows: Sequence[Row], chosen_on: Sequence[str]) -> dict[str, float]:
    """How well every baseline ranks the same splats (area under the ROC curve).

    The classifier is trained on what the method was chosen on: the contents named, and their first kind of attack.
    """
    held = [row for row in rows if row["content"] not in chosen_on and not row["derived"]]
    known = [row for row in rows if row["content"] in chosen_on]
    names = list(held[0].get("scores", ()))
    told = {
        name: ranked_above(*([row["scores"][name] for row in kind(held)] for kind in (positives, negatives)))
        for name in names
    }
    hiding, honest = positives(known), negatives(known)
    hiding = [row for row in hiding if row["part"] == hiding[0]["part"]]
    if names and hiding and honest:
        labels = [True] * len(hiding) + [False] * len(honest)
        classifier = fit_attributes(_attributes([*hiding, *honest]), labels)
        ranked = (classifier.odds(_attributes(kind(held))).tolist() for kind in (positives, negatives))
        told["classifier of attributes"] = ranked_above(*ranked)
    return told


def _attributes(rows: Sequence[Row]) -> Tensor:
    """(N, F) attributes of splats."""
    return torch.tensor([row["attributes"] for row in rows], dtype=torch.float64)


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
        "AUROC": lambda line: f"{line[1]['auroc']:.3f} ({line[1]['interval'][0]:.3f} to {line[1]['interval'][1]:.3f})",
        "directions, median IoU": lambda line: _number(line[1]["directions"]),
        "Gaussians, median AUROC": lambda line: _number(line[1]["heat"]),
        "Gaussians, median IoU": lambda line: _number(line[1]["mask"]),
    }
    caption = f"Told from {told['honest']} honest files; without {chosen}" if chosen else "Told from honest files"
    yield Table.of(f"{caption}; false alarms {cell(told['false_alarms'])}", heads, told["parts"].items())
    rivals = {"the audit": told["parts"]["all"]["auroc"], **told["rivals"]} if told["parts"] else {}
    heads = {"what ranks them": lambda line: line[0], "AUROC": lambda line: f"{line[1]:.3f}"}
    yield Table.of("Other ways to find a hidden look", heads, rivals.items())
    for title, chosen_rows in (("hide something", positives), ("are honest", negatives), ("failed attacks", _failed)):
        rows = sorted(chosen_rows(record["files"]), key=lambda row: -row["evidence"])
        columns: dict[str, Column[Any]] = {
            "file": lambda row: f"{row['part']}: {row['value']}, {row['splat']}",
            "missed by detectors": lambda row: "; ".join(Rate.of(rate).counts for rate in row["missed"].values()),
            "verdict": "verdict",
            "evidence": lambda row: f"{row['evidence']:.2f}",
            "excess": lambda row: f"{row['excess']:.4f}",
            "occluder": lambda row: f"{row['occluder']:.2f}",
            "directions": lambda row: _number(row.get("directions")),
            "heat": lambda row: _number(row.get("heat")),
            "mask": lambda row: _number(row.get("mask")),
        }
        yield Table.of(f"Files that {title}" if title != "failed attacks" else "Failed attacks", columns, rows)


def _failed(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["splat"] == CLOAKED and not row["hides"]]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
