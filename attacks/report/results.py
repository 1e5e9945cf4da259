"""Results as sections: which command has written a folder, and what reads it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from attacks.report.checking import Figures, Result
from attacks.report.section import Section, sentence, versions_of
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.folders import MANIFEST, RECORD, check_links, file_in, read_manifest
from mi_splat.io.parsing import read_json

Record = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class ResultKind:
    """A kind of result; what it names as `module:name` is imported when it is used,
    since it takes seconds.
    """

    name: str  # what writes it; also what its record says under `story`
    # in attacks.report.kinds: makes the section of a folder and of what its record
    # holds
    reader: str
    # derives its figures from its rows; empty for a kind without rows
    counter: str = ""
    # patterns of numbers in its record that are settings, or measured and in no rows
    given: tuple[str, ...] = ()

    @property
    def read(self) -> Callable[[Path, Record], Section]:
        """The function that `reader` names."""
        function: Callable[[Path, Record], Section] = resolve_name(
            f"attacks.report.kinds.{self.reader}"
        )
        return function

    @property
    def figures(self) -> Figures | None:
        """The function that `counter` names."""
        if not self.counter:
            return None
        function: Figures = resolve_name(f"attacks.{self.counter}")
        return function


_PROVENANCE = (
    *(
        "torch/*",
        "seconds",
        "cpu_seconds",
        "seed",
        "seeds/*",
        "versions/*",
        "config/*",
        "selection/*",
    ),
    *(
        "cameras/*",
        "reference/*",
        "redraws/*",
        "background/*",
        "near",
        "up/*",
        "min_confidence",
        "object_gaussians",
    ),
)
"""Numbers that every record may hold: how it was made, from where, of how many
Gaussians, and how long that took.
"""
_OF_DAGGER = (
    *_PROVENANCE,
    *("eps", "radius/*", "used/*", "used_in_file/*"),
    *(
        "steps",
        "evaluations",
        "loss",
        "trace/*",
        "zero_gradient_fraction/*",
        "clamped_fraction",
    ),
    *("changed_gaussians", "*psnr*", "image/*", "views/*"),
)
_OF_ATTACKS = ("attacks/*", "of_all_attacks/*")
_OF_BENCH = (
    "cpu_seconds/*",
    "detector/classes",
    "attacks/*/settings/*",
    "attacks/*/labels/*",
)
_OF_VICTIMS = ("victims/*", "values/*/stopped")
_OF_SPLATS = ("study/*", "splats/*/seed", "splats/*/gaussians")

RESULT_KINDS = (
    ResultKind("dagger", "dagger:read_attack", "dagger.result:figures", _OF_DAGGER),
    ResultKind("dagger-eot", "dagger:read_attack", "dagger.result:figures", _OF_DAGGER),
    ResultKind(
        "study",
        "dagger:read_study",
        "studies.result:figures",
        (*_PROVENANCE, *_OF_ATTACKS),
    ),
    ResultKind(
        "cloak",
        "cloak:read_cloak",
        "report.kinds.cloak:cloak_figures",
        (*_PROVENANCE, *_OF_SPLATS),
    ),
    ResultKind(
        "cloak-study",
        "cloak:read_study",
        "report.kinds.cloak:study_figures_of_points",
        (
            *_PROVENANCE,
            *(f"points/*/{pattern}" for pattern in (*_OF_SPLATS, "seeds/*")),
        ),
    ),
    ResultKind(
        "poison-study",
        "poison:read_study",
        "studies.poison_figures:figures",
        (*_PROVENANCE, *_OF_VICTIMS),
    ),
    ResultKind("audit", "audit:read_audit"),
    ResultKind(
        "evaluate",
        "detectors:read_evaluation",
        "report.kinds.detectors:evaluation_figures",
        _PROVENANCE,
    ),
    ResultKind(
        "bench", "detectors:read_bench", "bench.row:figures", (*_PROVENANCE, *_OF_BENCH)
    ),
)
"""Every kind of result that a page can show."""


def read_section(path: Path) -> Section:
    """What a page says of one result; whatever is broken in it is told in one line."""
    file = path / RECORD
    commands = ", ".join(f"mi-splat {kind.name}" for kind in RESULT_KINDS)
    if not file.is_file():
        got = "one without a result" if path.is_dir() else "nothing there"
        do = "check the path"
        if path.is_file():
            got = "a file"
            do = f"pass {path.parent}"
        raise InvalidValueError.of(
            str(path), f"a folder that one of {commands} has written", got, do
        )
    check_links(path)
    record = read_json(file)
    kind = _kind(record)
    if kind is None:
        raise InvalidValueError.of(
            str(file),
            f"a result of {commands}",
            "something else",
            "make the result again",
        )
    try:
        return _finished(kind.read(path, record), path, record)
    except MiSplatError:
        raise
    except (
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        StopIteration,
    ) as error:
        expected = f"a finished result of mi-splat {kind.name}"
        do = "make the result again"
        got = f"a broken or an older one ({type(error).__name__}: {error})"
        raise InvalidValueError.of(str(file), expected, got, do) from error


def _finished(section: Section, path: Path, record: Record) -> Section:
    """A section with what all results have, and without what is empty."""
    control = section.control
    return replace(
        section,
        folder=str(path),
        control=(
            None
            if control is None or (control.rate is not None and not control.rate.total)
            else control
        ),
        warnings=tuple(map(sentence, (*section.doubts(), *section.warnings))),
        pictures=tuple(
            picture
            for picture in section.pictures
            if _of_folder(path, picture.path).is_file()
        ),
        charts=tuple(chart for chart in section.charts if chart.drawn),
        tables=tuple(table for table in section.tables if table.rows),
        command=str(record.get("command") or ""),
        versions=versions_of(record),
        manifest=read_manifest(path).sha256 if (path / MANIFEST).is_file() else "",
    )


def _of_folder(folder: Path, path: Path) -> Path:
    """The path of a file on a page, which is one of the result's own, whatever kind of
    result it is.
    """
    return file_in(folder, path.relative_to(folder).as_posix())


def kind_of(result: Result) -> ResultKind:
    """The kind of a result."""
    kind = _kind(result.record)
    if kind is None:
        got = result.kind[:40]
        do = "make the result again with this version"
        raise InvalidValueError.of(
            str(result.folder / RECORD), "a story of this version", got, do
        )
    return kind


def _kind(record: Record) -> ResultKind | None:
    return next(
        (kind for kind in RESULT_KINDS if kind.name == record.get("story")), None
    )
