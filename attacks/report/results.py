"""Results as sections: which command has written a folder, and what reads it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from pkgutil import resolve_name

from attacks.figures.result import Result, read_result
from attacks.report.checking import Derive
from attacks.report.section import Section, sentence, versions_of
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.folders import MANIFEST, RECORD, check_links, file_in


@dataclass(frozen=True, slots=True)
class ResultKind:
    """A kind of result; what it names as `module:name` is imported when it is used,
    since it takes seconds.
    """

    name: str  # what writes it; also what its record says under `story`
    reader: str  # in attacks.report.kinds: makes the section of a result
    # derives its figures from its rows; empty for a kind without rows
    counter: str = ""

    @property
    def read(self) -> Callable[[Result], Section]:
        """The function that `reader` names."""
        function: Callable[[Result], Section] = resolve_name(
            f"attacks.report.kinds.{self.reader}"
        )
        return function

    @property
    def derive(self) -> Derive | None:
        """The function that `counter` names."""
        if not self.counter:
            return None
        function: Derive = resolve_name(f"attacks.{self.counter}")
        return function


RESULT_KINDS = (
    ResultKind("dagger", "dagger:read_attack", "dagger.figures:figures"),
    ResultKind("dagger-eot", "dagger:read_attack", "dagger.figures:figures"),
    ResultKind("study", "dagger_study:read_study", "studies.result:figures"),
    ResultKind("cloak", "cloak:read_cloak", "cloak.recorded:figures"),
    ResultKind(
        "cloak-study", "cloak_study:read_study", "studies.cloak_figures:figures"
    ),
    ResultKind("poison-study", "poison:read_study", "studies.poison_figures:figures"),
    ResultKind("audit", "audit:read_audit"),
    ResultKind("image-audit", "image_audit:read_image_audit"),
    ResultKind("evaluate", "detectors:read_evaluation", "observe.comparison:figures"),
    ResultKind("bench", "detectors:read_bench", "bench.row:figures"),
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
    result = read_result(path)
    kind = _kind(result)
    if kind is None:
        raise InvalidValueError.of(
            str(file),
            f"a result of {commands}",
            "something else",
            "make the result again",
        )
    try:
        return _finished(kind.read(result), result)
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


def _finished(section: Section, result: Result) -> Section:
    """A section with what all results have, and without what is empty."""
    path = result.folder
    record = result.record
    control = section.control
    if control is not None and control.rate is not None and not control.rate.total:
        control = None
    return replace(
        section,
        folder=str(path),
        control=control,
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
        manifest=result.manifest.sha256 if (path / MANIFEST).is_file() else "",
    )


def _of_folder(folder: Path, path: Path) -> Path:
    """The path of a file on a page, which is one of the result's own, whatever kind of
    result it is.
    """
    return file_in(folder, path.relative_to(folder).as_posix())


def kind_of(result: Result) -> ResultKind:
    """The kind of a result."""
    kind = _kind(result)
    if kind is None:
        got = result.kind[:40]
        do = "make the result again with this version"
        raise InvalidValueError.of(
            str(result.folder / RECORD), "a story of this version", got, do
        )
    return kind


def _kind(result: Result) -> ResultKind | None:
    return next((kind for kind in RESULT_KINDS if kind.name == result.kind), None)
