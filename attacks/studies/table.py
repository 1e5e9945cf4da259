"""The tables of a study as a page of Markdown: what was reached, by what varies, and what was seen otherwise."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from attacks.rate import Rate
from attacks.studies.study_file import merged
from attacks.studies.zoo import comparison
from attacks.tables import Table, sections

Record = Mapping[str, Any]
SHARED = "of_all_attacks"
"""Key of result.json under which stands what all attacks share."""
Cell = Callable[[Record], str]


def markdown(record: Record) -> str:
    """All tables of a study as a page."""
    head = [f"# {record.get('question') or record['name']}", "", *_introduction(record), ""]
    return "\n".join(head) + f"\n{sections(tables(record))}"


def tables(record: Record) -> Iterator[Table]:
    """All tables of a study: what its attacks have reached, the smallest that suffices, and what others see."""
    for title, groups in by_part(record["groups"]).items():
        compared = list(comparison(title, groups))
        columns = {**_axes(groups), **(_OF_VIEWS if "rate" in groups[0] else _OF_ATTACKS)}
        yield from compared or [Table.of(title or "The attacks", columns, groups)]
    for title, searched in by_part(record["smallest"]).items():
        caption = f"The smallest that suffices{f': {title}' if title else ''}"
        yield Table.of(caption, {**_axes(searched), **_OF_SEARCHES}, searched)
    for title, looks in by_part(record["looks"]).items():
        for kind, meaning in KINDS.items():
            if kind in looks[0]:
                yield _matrix(f"{meaning}{f': {title}' if title else ''}", looks, kind)


def number(value: Any, form: str = "g") -> str:
    """A number in a format, a dash for none; texts stay."""
    return "-" if value is None else format(value, form) if isinstance(value, (int, float)) else str(value)


def _rate(name: str, *, interval: bool = False) -> Cell:
    return lambda line: Rate.of(line[name]).short(interval=interval)


def _number(name: str, form: str = "g") -> Cell:
    return lambda line: number(line[name], form)


_OF_ATTACKS: dict[str, Cell] = {
    "success": _rate("success"),
    "strictly": _rate("strict"),
    "confidence (least)": lambda line: f"{number(line['score'], '.2f')} ({number(line['score_least'], '.2f')})",
    "original after": _number("original_after", ".2f"),
    "steps": _number("steps"),
    "PSNR, dB": _number("image_psnr", ".1f"),
    "on the object": _number("psnr_object", ".1f"),
    "noise success": lambda line: f"{line['noise_successes']}/{line['noise_draws']}",
    "noise best": _number("noise_best", ".2f"),
}
_OF_VIEWS: dict[str, Cell] = {
    "views": _rate("rate", interval=True),
    "strictly": _rate("strict_rate"),
    "noise": _rate("noise_rate"),
    "clean": _rate("clean_rate"),
    "PSNR, dB": _number("image_psnr", ".1f"),
    "on the object": _number("psnr_object", ".1f"),
    "steps": _number("steps"),
    "seconds": _number("seconds", ".0f"),
}
_OF_SEARCHES: dict[str, Cell] = {
    "smallest": _number("smallest"),
    "largest that does not": _number("not_enough"),
}
KINDS = {
    "targeted": "The wanted class is reported",
    "untargeted": "The object's class is no longer reported",
    "reached": "The objective of the attack is reached",
}


def _introduction(record: Record) -> list[str]:
    attacks = list(attacks_of(record).values())
    seeds = ", ".join(str(seed) for seed in sorted({attack["seed"] for attack in attacks}))
    weights = "; ".join(f"{name} {mark}" for name, mark in record["detectors"].items())
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    variants = ", ".join(dict.fromkeys(str(attack.get("variant")) for attack in attacks))
    return [
        f"{len(attacks)} attacks, seeds {seeds}. Every attack is judged on the saved file, in pictures of 8 bits. "
        "Strictly: the object's own class is gone, too (below 0.5). Medians are over seeds; noise is random noise of "
        "the size of the attack in the same norm; intervals are of 95 %.",
        "",
        f"Weights: {weights}. Versions: {versions}; variant {variants}; commit {record['commit']}.",
    ]


def attacks_of(record: Record) -> dict[str, Any]:
    """Every attack of a study with all that is stated of it, by its name."""
    return {name: merged(record.get(SHARED, {}), attack) for name, attack in record["attacks"].items()}


def by_part(lines: Sequence[Record]) -> dict[str, list[Record]]:
    """Lines by the part of the study that they are of."""
    parts: dict[str, list[Record]] = {}
    for line in lines:
        parts.setdefault(line["part"], []).append(line)
    return parts


def _axes(lines: Sequence[Record]) -> dict[str, Cell]:
    """A column for each axis."""
    names = dict.fromkeys(name for line in lines for name in line["labels"])
    return {title_of(name): lambda line, name=name: number(line["labels"].get(name)) for name in names}  # type: ignore[misc]


def title_of(axis: str) -> str:
    """What an axis is called at the head of a column."""
    return axis.removeprefix("attack.").replace("_", " ")


def _matrix(caption: str, looks: Sequence[Record], kind: str) -> Table:
    """Who judges, and how, against what was attacked; the longer of the two downwards, and the noise of all of it."""
    judges = _names(looks, ("condition", "detector"))
    attacks = _names(looks, ("labels",))
    cells = {(attacks[id(look)], judges[id(look)]): look for look in looks}
    across, down = (dict.fromkeys(names.values()) for names in (attacks, judges))
    turned = len(across) > len(down)
    if turned:
        across, down = down, across

    def cell(row: str, column: str) -> str:
        look = cells.get((row, column) if turned else (column, row))
        return (
            "-"
            if look is None
            else Rate.of(look[kind]).short(interval=True) + (" *" if look["white_box"] and marked else "")
        )

    def noise(row: str) -> str:
        members = [look for look in looks if row == (attacks if turned else judges)[id(look)]]
        rates = [look[f"noise_{kind}"] for look in members]
        return f"{sum(rate['successes'] for rate in rates)}/{sum(rate['total'] for rate in rates)}"

    marked = len({look["detector"] for look in looks}) > 1
    head = "attacked, judged by" if turned else "judged by"
    columns: dict[str, Cell] = {head: lambda line: line["row"] or "all"}
    columns |= {name or "all": lambda line, name=name: cell(line["row"], name) for name in across}  # type: ignore[misc]
    columns["random noise"] = lambda line: noise(line["row"])
    note = " (a star: the detector that judges was attacked)" if marked else ""
    return Table.of(f"{caption}{note}", columns, [{"row": row} for row in down])


def _names(looks: Sequence[Record], keys: Sequence[str]) -> dict[int, str]:
    """What each look is called by some of its keys, those apart that are the same in all looks."""
    values = {id(look): _flat(look, keys) for look in looks}
    several = [key for key in next(iter(values.values())) if len({parts.get(key) for parts in values.values()}) > 1]
    return {
        name: ", ".join(_cell_text(key, parts[key]) for key in several if parts.get(key) is not None)
        for name, parts in values.items()
    }


def _cell_text(key: str, value: Any) -> str:
    return str(value) if isinstance(value, str) else f"{title_of(key)} {number(value)}"


def _flat(look: Record, keys: Sequence[str]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key in keys:
        flat |= look[key] if isinstance(look[key], Mapping) else {key: look[key]}
    return flat
