"""What `mi-splat study run` leaves behind: many attacks, and how others see what came of them."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.rate import Rate, pooled
from attacks.report.section import Chart, Figure, Line, Section, capital, listed, plural, shared
from attacks.studies.table import KINDS, attacks_of, by_part, tables, title_of
from attacks.studies.zoo import by_attack, doubts, together

Record = Mapping[str, Any]
_NUMBER = re.compile(r"\d+(\.\d+)?")
_JUDGES = {True: "attacked detectors", False: "detectors that were not attacked"}


def read(folder: Path, record: Record) -> Section:
    """The section of a study."""
    attacks = list(attacks_of(record).values())
    label, counting, lines, key = _headline(record)
    rate, noise = pooled(line[key] for line in lines), pooled(_noise(line, key) for line in lines)
    control = f"; random noise of the same size: {noise.counts}" if noise.total else ""
    names = sorted({name for attack in attacks for name in attack["sources"]})
    return Section(
        kind="DAGGER, a study",
        title=f"{record['name']}, {plural(len(attacks), 'attack')}",
        done=(
            f"{record.get('question', '')} {plural(len(attacks), 'attack')} on {listed(names)}. Each is judged on the "
            "saved file, in 8-bit pictures, beside random noise of its size."
        ).strip(),
        conclusion=(
            f"{capital(label)}: {rate.counts}{control}. Views of one attack are not independent. This says nothing of "
            "other detectors, objects or budgets."
        ),
        headline=Figure(label=label, rate=rate),
        control=Figure(label="random noise of the same size", rate=noise),
        counting=counting,
        figures=tuple(_figures(record)),
        warnings=(*_warnings(attacks), *doubts(record["groups"]), *_doubts(record["looks"])),
        charts=tuple(_charts(record)),
        tables=tuple(tables(record)),
        configuration=shared([*(attack["settings"] for attack in attacks), {"weights": record["detectors"]}]),
    )


def _headline(record: Record) -> tuple[str, str, list[Record], str]:
    """The figure that matters: its name, what it counts, the lines that it is of, and their key.

    It is that of the attacks of the first part; of a study of looks, whose attacks have no control of their own, that
    of detectors that were not attacked, if there are such.
    """
    groups, looks = record["groups"], record["looks"]
    members = [group for group in groups if group["part"] == groups[0]["part"]]
    if members and (not looks or pooled(_noise(group, _key(group)) for group in members).total):
        part, key = members[0]["part"], _key(members[0])
        counting, aim = ("held-out views", "success") if key == "rate" else ("attacks", "the aim reached")
        return f"{counting} with {aim}{f' ({part})' if part else ''}", counting, members, key
    others = [look for look in looks if not look["white_box"]] or list(looks)
    key = next(kind for kind in KINDS if kind in others[0])
    return f"{_JUDGES[others[0]['white_box']]}: {KINDS[key].lower()}", "looks", others, key


def _key(group: Record) -> str:
    """What a group has reached: a rate of the views of a region, or of its attacks."""
    return "rate" if "rate" in group else "success"


def _noise(line: Record, key: str) -> Record:
    """The control of a rate of a group or of looks."""
    if key == "success":
        return {"successes": line["noise_successes"], "total": line["noise_draws"]}
    control: Record = line[f"noise_{key}"]
    return control


def _figures(record: Record) -> Iterator[Figure]:
    """Further figures: every aim of the attacks, and who else is deceived."""
    groups, looks = record["groups"], record["looks"]
    if groups:
        reached = [attack["success"] for attack in record["attacks"].values() if "success" in attack]
        yield Figure(label="attacks with the aim reached", rate=Rate(successes=sum(reached), total=len(reached)))
        strict = "strict_rate" if "rate" in groups[0] else "strict"
        yield Figure(label="with the object's own class gone, too", rate=pooled(group[strict] for group in groups))
    for white_box, judges in _JUDGES.items():
        for kind, meaning in KINDS.items():
            for key, what in ((kind, meaning.lower()), (f"noise_{kind}", f"{meaning.lower()}, with noise alone")):
                rates = [look[key] for look in looks if look["white_box"] is white_box and key in look]
                if rates:
                    yield Figure(label=f"{judges}: {what}", rate=pooled(rates))


def _warnings(attacks: Sequence[Record]) -> Iterator[str]:
    """The warnings of the attacks; of those that differ in a number alone, the most frequent."""
    kinds: dict[str, Counter[str]] = {}
    for text in (text for attack in attacks for text in attack.get("warnings", ())):
        kinds.setdefault(_NUMBER.sub("", text), Counter())[text] += 1
    for texts in kinds.values():
        example = "for instance, " if len(texts) > 1 else ""
        yield f"{texts.total()} of {plural(len(attacks), 'attack')}: {example}{texts.most_common(1)[0][0]}"


def _doubts(looks: Sequence[Record]) -> Iterator[str]:
    """Judges that do not see the clean object, and figures that noise reaches, so that they say nothing."""
    others = [look for look in looks if not look["white_box"] and "untargeted" in look]
    gone, noise = (pooled(look[key] for look in others) for key in ("untargeted", "noise_untargeted"))
    if gone.successes and noise.total and noise.fraction >= gone.fraction:
        yield (
            f"to detectors that were not attacked, random noise hides the object as often ({noise.counts}) as the "
            f"attacks do ({gone.counts})"
        )
    for look in looks:
        seen = Rate.of(look["found"])
        if seen.fraction < 0.5:
            yield f"{look['detector']} finds the clean object in {seen.words} of its looks only ({_labels(look)})"


def _labels(look: Record) -> str:
    return ", ".join([*(f"{title_of(axis)} {label}" for axis, label in look["labels"].items()), str(look["condition"])])


def _charts(record: Record) -> Iterator[Chart]:
    """The success of every line of a table, and what each judge reports, with noise beside it."""
    for title, groups in by_part(record["groups"]).items():
        key, ticks, below = _key(groups[0]), tuple(map(str, range(1, len(groups) + 1))), "line of the table"
        what = "views with success" if key == "rate" else "attacks with the aim reached"
        if compared := by_attack(groups):
            groups, ticks, below = [together(of_one) for of_one in compared.values()], tuple(compared), "attack"
        yield _chart(title or "The attacks", (below, what), groups, key, ticks)
    for title, looks in by_part(record["looks"]).items():
        names = tuple(f"{look['detector']}, {_labels(look)}" for look in looks)
        for kind, meaning in KINDS.items():
            if kind in looks[0]:
                yield _chart(f"{meaning}{f': {title}' if title else ''}", ("look", "rate"), looks, kind, names)


def _chart(title: str, labels: tuple[str, str], lines: Sequence[Record], key: str, ticks: tuple[str, ...]) -> Chart:
    """Rates of groups or looks beside each other, and those of noise."""
    attacked = Line.of("attack", "attack", [line[key] for line in lines])
    noise = Line.of("random noise", "control", [_noise(line, key) for line in lines])
    return Chart.bars(title, labels, ticks, attacked, noise)
