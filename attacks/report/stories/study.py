"""What `mi-splat study run` leaves behind: many attacks, and how others see what came of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.rate import Rate
from attacks.report.section import Chart, Figure, Line, Section, doubts_of
from attacks.report.wording import capital, listed, plural, pooled, sentence, shared
from attacks.studies.table import KINDS, by_part, tables, title_of
from attacks.tables import cell

Record = Mapping[str, Any]
_NOISE = "random noise of the same size"


def read(folder: Path, record: Record) -> Section:
    """The section of a study.

    Args:
        folder: Where it lies.
        record: Its result.json.
    """
    attacks, groups = list(record["attacks"].values()), record["groups"]
    headline, control, what = _of_groups(groups) if groups else _of_looks(record["looks"])
    noise = None if control is None else control.rate
    assert headline.rate is not None
    names = sorted({name for attack in attacks for name in attack["sources"]})
    return Section(
        kind="DAGGER, a study",
        title=f"{record['name']}, {plural(len(attacks), 'attack')}",
        folder=str(folder),
        done=(
            f"{record.get('question', '')} {plural(len(attacks), 'attack')} on {listed(names)}. Each is judged on the "
            "saved file, in 8-bit pictures, beside random noise of its size."
        ).strip(),
        conclusion=(
            f"{capital(headline.label)}: {headline.counts}{f'; {control.label}: {control.counts}' if control else ''}. "
            "Views of one attack are not independent. This says nothing of other detectors, objects or budgets."
        ),
        headline=headline,
        control=control,
        figures=tuple(_more(record)),
        warnings=tuple(
            map(sentence, [*doubts_of(headline.rate, noise, what=what), *_warnings(attacks), *_unseen(record)])
        ),
        charts=tuple(_charts(record)),
        tables=tuple(tables(record)),
        configuration=shared([*(attack["settings"] for attack in attacks), {"weights": record["detectors"]}]),
    )


def _of_groups(groups: Sequence[Record]) -> tuple[Figure, Figure | None, str]:
    """The figure of the attacks that matters, its control, and what they count: those of the first part."""
    part = groups[0]["part"]
    members = [group for group in groups if group["part"] == part]
    of = f" ({part})" if part else ""
    if "rate" in members[0]:
        rate, noise = (pooled(Rate.of(group[name]) for group in members) for name in ("rate", "noise_rate"))
        label, what = f"held-out views with success{of}", "held-out views"
    else:
        rate, noise = pooled(Rate.of(group["success"]) for group in members), _noise_of(members)
        label, what = f"attacks with the aim reached{of}", "attacks"
    return Figure(label=label, rate=rate), Figure(label=_NOISE, rate=noise) if noise.total else None, what


def _noise_of(groups: Sequence[Record]) -> Rate:
    counts = [(group["noise_successes"], group["noise_draws"]) for group in groups]
    return Rate(successes=sum(successes for successes, _ in counts), total=sum(draws for _, draws in counts))


def _of_looks(looks: Sequence[Record]) -> tuple[Figure, Figure | None, str]:
    """The figure of looks that matters: of detectors that were not attacked, if there are such."""
    others = [look for look in looks if not look["white_box"]] or list(looks)
    kind = "targeted" if "targeted" in others[0] else "untargeted"
    rate, noise = (pooled(Rate.of(look[name]) for look in others) for name in (kind, f"noise_{kind}"))
    who = "attacked detectors" if others[0]["white_box"] else "detectors that were not attacked"
    figure = Figure(label=f"{who}: {KINDS[kind].lower()}", rate=rate)
    return figure, Figure(label=_NOISE, rate=noise) if noise.total else None, "looks"


def _more(record: Record) -> Iterator[Figure]:
    """Further figures: every aim of the attacks, and who else is deceived."""
    groups, looks = record["groups"], record["looks"]
    if groups:
        held = [attack["success"] for attack in record["attacks"].values() if "success" in attack]
        yield Figure(label="attacks with the aim reached", rate=Rate(successes=sum(held), total=len(held)))
        strict = "strict_rate" if "rate" in groups[0] else "strict"
        label = "with the object's own class gone, too"
        yield Figure(label=label, rate=pooled(Rate.of(group[strict]) for group in groups))
    for white_box, who in ((True, "attacked detectors"), (False, "detectors that were not attacked")):
        for kind, meaning in KINDS.items():
            for name, what in ((kind, meaning.lower()), (f"noise_{kind}", f"{meaning.lower()}, with noise alone")):
                rates = [Rate.of(look[name]) for look in looks if look["white_box"] is white_box and name in look]
                if rates:
                    yield Figure(label=f"{who}: {what}", rate=pooled(rates))


def _warnings(attacks: Sequence[Record]) -> Iterator[str]:
    """The warnings of the attacks, each once."""
    for text, times in Counter(text for attack in attacks for text in attack.get("warnings", ())).items():
        yield f"{times} of {plural(len(attacks), 'attack')}: {text}"


def _unseen(record: Record) -> Iterator[str]:
    """Judges that do not see the clean object, and figures that noise reaches, so that they say nothing."""
    looks = record["looks"]
    others = [look for look in looks if not look["white_box"]]
    gone, noise = (pooled(Rate.of(look[name]) for look in others) for name in ("untargeted", "noise_untargeted"))
    if gone.successes and noise.total and noise.fraction >= gone.fraction:
        yield (
            f"to detectors that were not attacked, random noise hides the object as often ({noise.counts}) as the "
            f"attacks do ({gone.counts})"
        )
    for look in looks:
        seen = Rate.of(look["found"])
        if seen.fraction < 0.5:
            yield f"{look['detector']} finds the clean object in {cell(seen)} of its looks only ({_where(look)})"


def _where(look: Record) -> str:
    labels = [f"{title_of(axis)} {label}" for axis, label in look["labels"].items()]
    return ", ".join([*labels, str(look["condition"])])


def _charts(record: Record) -> Iterator[Chart]:
    """The success of every line of a table, and what each judge reports, with noise beside it."""
    for title, groups in by_part(record["groups"]).items():
        drawn = "rate" in groups[0]
        noise = [Rate.of(group["noise_rate"]) if drawn else _noise_of([group]) for group in groups]
        rates = [Rate.of(group["rate" if drawn else "success"]) for group in groups]
        what = "views with success" if drawn else "attacks with the aim reached"
        yield _chart(title or "The attacks", "line of the table", what, rates, noise)
    for title, looks in by_part(record["looks"]).items():
        for kind, meaning in KINDS.items():
            if kind in looks[0]:
                rates, noise = ([Rate.of(look[name]) for look in looks] for name in (kind, f"noise_{kind}"))
                ticks = tuple(f"{look['detector']}, {_where(look)}" for look in looks)
                yield _chart(f"{meaning}{f': {title}' if title else ''}", "look", "rate", rates, noise, ticks)


def _chart(
    title: str, x_label: str, y_label: str, rates: Sequence[Rate], noise: Sequence[Rate], ticks: tuple[str, ...] = ()
) -> Chart:
    """Rates beside each other, and those of noise.

    Args:
        title: Heading.
        x_label: What each place is.
        y_label: What is counted.
        rates: Of the attacks.
        noise: Of the noise.
        ticks: Names of the places; empty for their numbers.
    """
    return Chart(
        title=title,
        caption="Bars are 95 % intervals.",
        x_label=x_label,
        y_label=y_label,
        lines=(Line.of("attack", "attack", rates), Line.of("random noise", "control", noise)),
        ticks=ticks or tuple(map(str, range(1, len(rates) + 1))),
        connected=False,
    )
