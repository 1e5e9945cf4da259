"""Results as sections: which command has written a folder or a file, and what reads it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from attacks.cloak.rates import markdown as cloak_markdown
from attacks.dagger.figures import figures as attack_figures
from attacks.detectors.evaluation import figures as detector_figures
from attacks.report.checking import Figures, Result
from attacks.report.rescoring import Rescoring
from attacks.report.section import Section
from attacks.report.stories import (
    attack,
    cloak,
    detection_curve,
    evaluation,
    experiments,
    limits,
    renderers,
    sanity,
    study,
    variations,
)
from attacks.report.stories.detectors import held_out, pictures
from attacks.report.wording import sentence, versions_of
from attacks.studies.cloak import markdown as cloak_study_markdown
from attacks.studies.result import figures as study_figures
from attacks.studies.table import sections
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.folders import RECORD
from mi_splat.io.manifest import MANIFEST, read_manifest
from mi_splat.io.parsing import read_json

Found = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Story:
    """A kind of result.

    Attributes:
        name: What writes it; also what its record says under `story`.
        read: Makes the section of a folder, or of the one file, and of what its record holds.
        figures: Derives its figures from its rows; None of a kind without rows.
        rescoring: How its splats are scored again; None of a kind that is not.
        markdown: Its tables for the documentation, from its record; None of a kind that has none.
        record: File by which it is known; of a result that is one file, what it is usually called.
        is_it: Whether such a file is of this kind; None goes by `story`.
        one_file: Whether the result is that one file, wherever it lies, and not a folder.
    """

    name: str
    read: Callable[[Path, Found], Section]
    figures: Figures | None = None
    rescoring: Rescoring | None = None
    markdown: Callable[[Found], str] | None = None
    record: str = RECORD
    is_it: Callable[[Found], bool] | None = None
    one_file: bool = False

    def holds(self, found: Found) -> bool:
        """Whether a record is of this kind."""
        return found.get("story") == self.name if self.is_it is None else self.is_it(found)


def _always(found: Found) -> bool:
    return True


_EXPERIMENTS = {
    **dict.fromkeys(experiments.EXPERIMENTS, experiments.read_conditions),
    "surroundings": experiments.read_surroundings,
    "perfect-splat": experiments.read_perfect_splat,
    "transition-limit": limits.read_transition_limit,
    "paint-direction": limits.read_paint_direction,
}
STORIES = (
    Story(name="dagger", read=attack.read, figures=attack_figures, rescoring=attack.RESCORING),
    Story(name="dagger-eot", read=attack.read, figures=attack_figures, rescoring=attack.RESCORING),
    Story(
        name="cloak",
        read=cloak.read,
        figures=cloak.figures,
        rescoring=cloak.RESCORING,
        markdown=cloak_markdown,
    ),
    Story(
        name="study",
        read=study.read,
        figures=study_figures,
        markdown=sections,
    ),
    Story(name="cloak-study", read=variations.read, figures=variations.figures, markdown=cloak_study_markdown),
    Story(name="evaluate", read=evaluation.read, figures=evaluation.figures),
    Story(name="compare", read=renderers.read),
    Story(name="detect", read=pictures.read),
    Story(name="evaluate-detector", read=held_out.read, figures=detector_figures),
    Story(name="dagger-sanity", read=sanity.read),
    Story(
        name="cloak-experiment detection-curve",
        record="detection-curve.json",
        is_it=_always,
        read=experiments.of_study(detection_curve.read),
    ),
    *(
        Story(
            name=f"cloak-experiment {name}",
            record=f"{name}.json",
            is_it=lambda one, name=name: one.get("experiment") == name,  # type: ignore[misc]
            read=experiments.of_study(read),
            one_file=True,
        )
        for name, read in _EXPERIMENTS.items()
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
    folders = [story for story in STORIES if not story.one_file]
    if not path.is_dir():
        raise InvalidValueError(message(str(path), "a folder of results", "nothing there", "check the path"))
    records = dict.fromkeys(story.record for story in folders if (path / story.record).is_file())
    if not records:
        expected = f"a folder that one of {_commands(folders)} has written"
        raise InvalidValueError(message(str(path), expected, "one without a result", "pass a finished result"))
    for record in records:
        found = read_json(path / record)
        for story in folders:
            if story.record == record and story.holds(found):
                return _read(story, path, path / record, found)
    where, expected = str(path / next(iter(records))), f"a result of {_commands(folders)}"
    raise InvalidValueError(message(where, expected, "something else", "make the result again"))


def _of_file(path: Path) -> Section:
    """The section of a result that is one file."""
    found = read_json(path) if path.suffix == ".json" else {}
    files = [story for story in STORIES if story.one_file]
    for story in files:
        if story.holds(found):
            return _read(story, path, path, found)
    expected = f"a folder of results, or a JSON file that one of {_commands(files)} has written"
    do = f"pass {path.parent}, or make the result again"
    raise InvalidValueError(message(str(path), expected, "another file", do))


def _commands(stories: Sequence[Story]) -> str:
    """The commands of some kinds, each once."""
    return ", ".join(dict.fromkeys(f"mi-splat {story.name.split()[0]}" for story in stories))


def _read(story: Story, path: Path, record: Path, found: Found) -> Section:
    """The section of a result; whatever is broken in it is told in one line."""
    try:
        return finished(story.read(path, found), path, found)
    except MiSplatError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, StopIteration) as error:
        expected, do = f"a finished result of mi-splat {story.name}", "make the result again"
        got = f"a broken or an older one ({type(error).__name__}: {error})"
        raise InvalidValueError(message(str(record), expected, got, do)) from error


def finished(section: Section, path: Path, record: Found) -> Section:
    """A section with what all results have, and without what is empty.

    Args:
        section: What the story says.
        path: Folder or file of the result.
        record: A document with what `mi_splat.provenance.origin` gives.
    """
    control = section.control
    return replace(
        section,
        folder=str(path),
        control=None if control is None or (control.rate is not None and not control.rate.total) else control,
        warnings=tuple(map(sentence, (*section.doubts(), *section.warnings))),
        pictures=tuple(picture for picture in section.pictures if picture.path.is_file()),
        charts=tuple(chart for chart in section.charts if any(line.points for line in chart.lines)),
        tables=tuple(table for table in section.tables if table.rows),
        command=str(record.get("command") or ""),
        versions=versions_of(record),
        manifest=read_manifest(path).sha256 if (path / MANIFEST).is_file() else "",
    )


def story_of(result: Result) -> Story:
    """The kind of a result.

    Raises:
        InvalidValueError: It is of none.
    """
    story = next((one for one in STORIES if one.record == RECORD and one.holds(result.record)), None)
    if story is None:
        got, do = result.story[:40], "make the result again with this version"
        raise InvalidValueError(message(str(result.folder / RECORD), "a story of this version", got, do))
    return story
