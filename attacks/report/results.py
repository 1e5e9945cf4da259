"""Results as sections: which command has written a folder or a file, and what reads it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from attacks.cloak.rates import markdown as cloak_markdown
from attacks.dagger.figures import figures as attack_figures
from attacks.report.checking import Figures, Result
from attacks.report.markdown import markdown
from attacks.report.rescoring import Rescoring
from attacks.report.section import Section
from attacks.report.stories import (
    cloak,
    dagger,
    eot,
    eot_study,
    evaluation,
    pairs,
    renderers,
    rendering_study,
    sanity,
    studies,
    study,
    transfer,
    variations,
)
from attacks.report.stories.detectors import comparison, held_out, pictures
from attacks.report.stories.experiments import detection_curve, limits, perfect_splat, splats
from attacks.report.wording import versions_of
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.folders import RECORD
from mi_splat.io.manifest import MANIFEST, read_manifest
from mi_splat.io.parsing import read_json

Found = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Story:
    """A kind of result.

    Attributes:
        command: What writes it.
        record: File by which it is known; of a result that is one file, what it is usually called.
        is_it: Whether such a file is of this kind.
        read: Makes the section of a folder, or of the one file, and of what that file holds.
        one_file: Whether the result is that one file, wherever it lies, and not a folder.
        made: The part of that file that says what made it.
        figures: Derives its figures from its rows; None of a kind without rows.
        rescoring: How its splats are scored again; None of a kind that is not.
        markdown: Its tables for the documentation, from its record; None of a kind that has none.
    """

    command: str
    record: str
    is_it: Callable[[Found], bool]
    read: Callable[[Path, Found], Section]
    one_file: bool = False
    made: Callable[[Found], Found] = lambda found: found
    figures: Figures | None = None
    rescoring: Rescoring | None = None
    markdown: Callable[[Found], str] | None = None


def _always(found: Found) -> bool:
    return True


STORIES = (
    Story(
        command="dagger",
        record=RECORD,
        is_it=lambda one: one.get("story") == "dagger",
        read=dagger.read,
        figures=attack_figures,
        rescoring=dagger.RESCORING,
    ),
    Story(
        command="dagger-eot",
        record=RECORD,
        is_it=lambda one: one.get("story") == "dagger-eot",
        read=eot.read,
        figures=attack_figures,
        rescoring=dagger.RESCORING,
    ),
    Story(
        command="cloak",
        record=RECORD,
        is_it=lambda one: one.get("story") == "cloak",
        read=cloak.read,
        figures=cloak.figures,
        rescoring=cloak.RESCORING,
        markdown=cloak_markdown,
    ),
    Story(
        command="study",
        record=RECORD,
        is_it=lambda one: one.get("story") == "study",
        read=studies.read,
        figures=studies.figures,
        markdown=lambda record: markdown(studies.tables(record)),
    ),
    Story(command="dagger-pairs", record="summary.json", is_it=lambda one: "pairs" in one, read=pairs.read),
    Story(command="cloak", record="summary.json", is_it=lambda one: "study" in one, read=cloak.read),
    Story(command="cloak --vary", record="variations.json", is_it=_always, read=variations.read, made=variations.first),
    Story(command="dagger-study", record="table.json", is_it=lambda one: "by_radius" in one, read=study.read),
    Story(command="dagger-eot-study", record="table.json", is_it=lambda one: "smallest" in one, read=eot_study.read),
    Story(command="dagger-transfer", record="transfer.json", is_it=_always, read=transfer.read),
    Story(command="dagger-transfer --eot-study", record="held_out.json", is_it=_always, read=transfer.read_held_out),
    Story(command="rendering-study", record="study.json", is_it=_always, read=rendering_study.read),
    Story(command="dagger-sanity", record="sanity.json", is_it=_always, read=sanity.read),
    Story(command="evaluate", record="evaluation.json", is_it=_always, read=evaluation.read),
    Story(command="compare", record="compare.json", is_it=_always, read=renderers.read),
    Story(command="detect", record="detections.json", is_it=_always, read=pictures.read),
    Story(
        command="cloak-experiment detection-curve",
        record="detection-curve.json",
        is_it=_always,
        read=detection_curve.read,
    ),
    Story(
        command="evaluate-detector",
        record="held-out.json",
        is_it=lambda one: {"detector", "sets", "false_positives"} <= set(one),
        read=held_out.read,
        one_file=True,
    ),
    Story(
        command="compare-detectors",
        record="comparison.compared.json",
        is_it=lambda one: "compared" in one,
        read=comparison.read,
        one_file=True,
    ),
    *(
        Story(
            command=f"cloak-experiment {name}",
            record=f"{name}.json",
            is_it=lambda one, name=name: one.get("experiment") == name,  # type: ignore[misc]
            read=read,
            one_file=True,
        )
        for name, read in (
            ("surroundings", splats.read_surroundings),
            ("distance", splats.read_distances),
            ("formats", splats.read_formats),
            ("renderers", splats.read_renderers),
            ("street", splats.read_street),
            ("transition-limit", limits.read_transition_limit),
            ("paint-direction", limits.read_paint_direction),
            ("perfect-splat", perfect_splat.read),
        )
    ),
)
"""Every kind of result that a page can show."""


def read_section(path: Path) -> Section:
    """What a page says of one result.

    Args:
        path: A folder of results, or the one JSON file that a command has written.

    Raises:
        InvalidValueError: It is none that one of `STORIES` names, or a file in it is broken.
    """
    if path.is_file():
        return _of_file(path)
    commands = _commands([kind for kind in STORIES if not kind.one_file])
    if not path.is_dir():
        raise InvalidValueError(message(str(path), "a folder of results", "nothing there", "check the path"))
    records = dict.fromkeys(kind.record for kind in STORIES if not kind.one_file and (path / kind.record).is_file())
    if not records:
        expected = f"a folder that one of {commands} has written"
        raise InvalidValueError(message(str(path), expected, "one without a result", "pass a finished result"))
    for record in records:
        found = read_json(path / record)
        for kind in STORIES:
            if not kind.one_file and kind.record == record and kind.is_it(found):
                return _read(kind, path, path / record, found)
    do = "make the result again"
    raise InvalidValueError(message(str(path / next(iter(records))), f"a result of {commands}", "something else", do))


def _of_file(path: Path) -> Section:
    """The section of a result that is one file."""
    found = read_json(path) if path.suffix == ".json" else {}
    for kind in STORIES:
        if kind.one_file and kind.is_it(found):
            return _read(kind, path, path, found)
    commands = _commands([kind for kind in STORIES if kind.one_file])
    expected = f"a folder of results, or a JSON file that one of {commands} has written"
    raise InvalidValueError(
        message(str(path), expected, "another file", f"pass {path.parent}, or make the result again")
    )


def _commands(kinds: Sequence[Story]) -> str:
    """The commands of some kinds, each once."""
    return ", ".join(dict.fromkeys(f"mi-splat {kind.command.split()[0]}" for kind in kinds))


def _read(kind: Story, path: Path, record: Path, found: Found) -> Section:
    """The section of a result; whatever is broken in it is told in one line."""
    try:
        section = with_origin(kind.read(path, found), kind.made(found))
        has_manifest = not kind.one_file and (path / MANIFEST).is_file()
        return replace(section, manifest=read_manifest(path).sha256) if has_manifest else section
    except MiSplatError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, StopIteration) as error:
        expected, do = f"a finished result of mi-splat {kind.command}", "make the result again"
        got = f"a broken or an older one ({type(error).__name__}: {error})"
        raise InvalidValueError(message(str(record), expected, got, do)) from error


def with_origin(section: Section, made: Found) -> Section:
    """A section with what made its result: the command line as it was given, and versions.

    Args:
        section: What else the page says.
        made: A document with what `mi_splat.provenance.origin` gives.
    """
    return replace(section, command=str(made.get("command") or ""), versions=versions_of(made))


def story_of(result: Result) -> Story:
    """The kind of a result.

    Raises:
        InvalidValueError: It is of none.
    """
    story = next((one for one in STORIES if one.record == RECORD and one.is_it(result.record)), None)
    if story is None:
        got, do = result.story[:40], "make the result again with this version"
        raise InvalidValueError(message(str(result.folder / RECORD), "a story of this version", got, do))
    return story
