"""What studies of DAGGER leave behind: many attacks, and what others see of them."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from attacks.figures.frame import Figures
from attacks.figures.rate import Rate, pooled
from attacks.figures.result import Result
from attacks.figures.tables import groups_of
from attacks.observe.rows import ATTACKED, NOISE
from attacks.report.kinds.dagger import control_of
from attacks.report.section import (
    Chart,
    Figure,
    Line,
    Section,
    capital,
    listed,
    shared,
)
from attacks.studies.result import (
    BLACK_BOX,
    EVALUATION,
    SETTING,
    WHITE_BOX,
    StudiedAttack,
    attacks_of,
)
from attacks.studies.tables import (
    KINDS,
    by_optimiser,
    of_parts,
    settings_of,
    tables,
    title_of,
)
from mi_splat.errors import counted

_NUMBER = re.compile(r"\d+(\.\d+)?")
_JUDGES = {
    WHITE_BOX: "attacked detectors",
    BLACK_BOX: "detectors that were not attacked",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Aim:
    """What attacks are judged by."""

    measure: str
    counting: str  # what it counts, in the plural
    words: str


_AIMS = (
    _Aim(measure="reached", counting="attacks", words="the aim reached"),
    _Aim(measure="success", counting="held-out views", words="success"),
    _Aim(
        measure="strict_if_detected",
        counting="attacks",
        words="the target class reported and the own class not",
    ),
)


def _aim_of(settings: Figures) -> _Aim:
    """The first aim that the figures of attacks have."""
    known = settings.labels("measure")
    return next(aim for aim in _AIMS if aim.measure in known)


def read_study(result: Result) -> Section:
    """The section of a study."""
    record = result.record
    figures = result.figures
    attacks = attacks_of(record)
    headline, control, counting = _headline(figures)
    beside = control_of(next(iter(attacks.values())).settings.get("attack", {}))
    noise = f"; {beside}: {control.counts}" if control.total else ""
    names = sorted({name for attack in attacks.values() for name in attack.sources})
    assert headline.rate is not None
    return Section(
        kind="DAGGER, a study",
        title=f"{record['name']}, {counted(len(attacks), 'attack')}",
        done=(
            f"{record.get('question', '')} {counted(len(attacks), 'attack')} on"
            f" {listed(names)}. Each is evaluated on the saved file, in 8-bit images,"
            " beside random noise."
        ).strip(),
        conclusion=(
            f"{capital(headline.label)}: {headline.rate.counts}{noise}. Views of one"
            " attack are not independent. This says nothing of other detectors, objects"
            " or budgets."
        ),
        headline=headline,
        control=Figure(label=beside, rate=control),
        counting=counting,
        figures=tuple(_figures(figures)),
        warnings=(*_warnings(attacks.values()), *_doubts(figures)),
        charts=tuple(_charts(figures)),
        tables=tuple(tables(figures)),
        configuration=shared(
            [
                *(attack.settings for attack in attacks.values()),
                {"weights": record["detectors"]},
            ]
        ),
    )


def _headline(figures: Figures) -> tuple[Figure, Rate, str]:
    """The figure that matters, its control, and what it counts.

    It is that of the attacks of the first part; of a study of evaluations, whose
    attacks have no control of their own, that of detectors that were not attacked, if
    there are such.
    """
    evaluations = figures.where(scope=EVALUATION)
    for part, settings in of_parts(figures, SETTING)[:1]:
        aim = _aim_of(settings)
        noise = settings.pooled(aim.measure, splat=NOISE)
        if noise.total or not len(evaluations):
            label = f"{aim.counting} with {aim.words}{f' ({part})' if part else ''}"
            rate = settings.pooled(aim.measure, splat=ATTACKED)
            return Figure(label=label, rate=rate), noise, aim.counting
    labels = evaluations.labels("access")
    access = BLACK_BOX if BLACK_BOX in labels else WHITE_BOX
    others = evaluations.where(access=access)
    kind = next(kind for kind in KINDS if kind in others.labels("measure"))
    label = f"{_JUDGES[access]}: {KINDS[kind].lower()}"
    rate = others.pooled(kind)
    return (
        Figure(label=label, rate=rate),
        others.pooled(f"noise_{kind}"),
        "looks",
    )


def _figures(figures: Figures) -> Iterator[Figure]:
    """Further figures: every aim of the attacks, and who else is deceived."""
    attacks = [one for (name,), one in figures.groups("attack").items() if name]
    settings = figures.where(scope=SETTING)
    known = settings.labels("measure")
    if "strict_if_detected" not in known or "success" in known:
        reached = pooled(one.rate("reached", splat=ATTACKED) for one in attacks)
        if reached.total:
            yield Figure(label="attack success rate (ASR)", rate=reached)
    strict = {
        "strict": "views with the object's own class gone, too",
        "reached_strictly": "attacks with the object's own class gone, too",
        "strict_if_detected": (
            "target class reported and the own class not, where the clean object is"
            " detected"
        ),
    }
    for measure, label in strict.items():
        if measure in known:
            rate = settings.pooled(measure, splat=ATTACKED)
            yield Figure(label=label, rate=rate)
    evaluations = figures.where(scope=EVALUATION)
    for access, judges in _JUDGES.items():
        seen = evaluations.where(access=access)
        for kind, meaning in KINDS.items():
            if kind in seen.labels("measure"):
                label = f"{judges}: {meaning.lower()}"
                yield Figure(label=label, rate=seen.pooled(kind))
                noise = seen.pooled(f"noise_{kind}")
                yield Figure(label=f"{label}, with noise only", rate=noise)


def _warnings(attacks: Iterable[StudiedAttack]) -> Iterator[str]:
    """The warnings of the attacks; of those that differ in a number alone, the most
    frequent.
    """
    several = list(attacks)
    kinds: dict[str, Counter[str]] = {}
    for attack in several:
        for text in attack.warnings:
            kinds.setdefault(_NUMBER.sub("", text), Counter())[text] += 1
    for texts in kinds.values():
        example = "for instance, " if len(texts) > 1 else ""
        usual = texts.most_common(1)[0][0]
        many = f"{texts.total()} of {counted(len(several), 'attack')}"
        yield f"{many}: {example}{usual}"


def _doubts(figures: Figures) -> Iterator[str]:
    """Judges that do not see the clean object, and figures that noise reaches, so that
    they say nothing.
    """
    evaluations = figures.where(scope=EVALUATION)
    others = evaluations.where(access=BLACK_BOX)
    gone = others.pooled("untargeted")
    noise = others.pooled("noise_untargeted")
    if gone.successes and noise.total and noise.fraction >= gone.fraction:
        yield (
            "to detectors that were not attacked, random noise hides the object as"
            f" often ({noise.counts}) as the attacks do ({gone.counts})"
        )
    names = ("detector", "access", "part", *evaluations.axes, "condition")
    for labels, seen in groups_of(evaluations, *names):
        found = seen.rate("found")
        if found.fraction < 0.5:
            yield (
                f"{labels['detector']} finds the clean object in {found.words} of its"
                f" looks only ({_where(labels, evaluations.axes)})"
            )


def _where(labels: Mapping[str, Any], axes: list[str]) -> str:
    known = [axis for axis in axes if labels[axis] is not None]
    words = [f"{title_of(axis)} {labels[axis]}" for axis in known]
    return ", ".join([*words, str(labels["condition"])])


def _charts(figures: Figures) -> Iterator[Chart]:
    """The success of every line of a table, with noise beside it."""
    for part, settings in of_parts(figures, SETTING):
        aim = _aim_of(settings)
        below = "line of the table"
        lines = {
            str(number): of_line
            for number, (_, of_line) in enumerate(settings_of(settings), 1)
        }
        compared = by_optimiser(settings)
        if compared:
            below = "attack"
            lines = compared
        rates = {
            splat: [
                of_line.pooled(aim.measure, splat=splat) for of_line in lines.values()
            ]
            for splat in (ATTACKED, NOISE)
        }
        what = f"{aim.counting} with {aim.words}"
        attacked = Line.of("attack", "attack", rates[ATTACKED])
        noise = Line.of("random noise", "control", rates[NOISE])
        title = part or "The attacks"
        yield Chart.bars(title, (below, what), tuple(lines), attacked, noise)
