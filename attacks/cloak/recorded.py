"""The figures of a result of CLOAK, derived from its rows, which are checked first."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from attacks.cloak.config import StudyConfig, recorded_study
from attacks.cloak.figures import figures as figures_of_study
from attacks.cloak.steps import CLOAKED, ROW_NAMES
from attacks.cloak.transition import Tables
from attacks.figures.frame import Figures
from attacks.observe.rows import CLEAN, FIDELITY, ROWS, TRANSITION
from mi_splat.errors import InvalidValueError


def figures(record: Mapping[str, Any], tables: Tables) -> Figures:
    """Every figure of a study, from its rows."""
    study = study_of(record)
    _check_rows(study, record["splats"], tables)
    return figures_of_study(study, tables, record["splats"])


def study_of(record: Mapping[str, Any]) -> StudyConfig:
    """The study of a result."""
    return recorded_study(record["study"], "study")


def _check_rows(
    study: StudyConfig, splats: Sequence[Mapping[str, Any]], tables: Tables
) -> None:
    """Raise unless the splats are those of the study, and every detector saw each once
    from the same cameras.

    Looks under conditions, which others do, may be of any detectors and cameras.
    """
    wanted = {(which, seed) for which in (CLEAN, CLOAKED) for seed in study.seeds}
    if sorted((splat["splat"], splat["seed"]) for splat in splats) != sorted(wanted):
        got = ", ".join(f"{splat['splat']} {splat['seed']}" for splat in splats)
        raise _wrong("splats", "a clean and a cloaked one for each seed", got or "none")
    splats_of_rows = {(ROW_NAMES[which], seed) for which, seed in wanted}
    for name in (ROWS, FIDELITY, TRANSITION):
        if not set(tables[name].select("splat", "seed").iter_rows()) <= splats_of_rows:
            raise _wrong(f"table {name}", "rows of the study's splats", "others")
    plain = tables[ROWS]
    if "condition" in plain.columns:
        plain = plain.filter(pl.col("condition").is_null())
    seen = Counter(plain.select("splat", "seed", "detector", "view").iter_rows())
    views = {key[3] for key in seen}
    for splat, seed in sorted(splats_of_rows):
        here = {key for key in seen if key[:2] == (splat, seed)}
        expected = {
            (splat, seed, name, view)
            for name in study.evaluation.detectors
            for view in views
        }
        if here != expected or not expected or any(seen[key] > 1 for key in here):
            lost = sorted(expected - here)
            if lost:
                got = f"none for {lost[0][2]}, view {lost[0][3]}"
            else:
                got = "others, or one twice"
            raise _wrong(
                f"table {ROWS}, {splat} splat, seed {seed}",
                "one row for each detector and camera",
                got,
            )


def _wrong(what: str, expected: str, got: str) -> InvalidValueError:
    return InvalidValueError.of(what, expected, got, "get the result again")
