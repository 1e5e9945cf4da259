"""Numbers, settings and lists as a page writes them."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from attacks.tables import named_settings

MOST_VALUES = 12
"""Values of one setting that are listed where several attacks differ in it."""


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} minutes" if seconds < 5400 else f"{seconds / 3600:.1f} hours"


def listed(words: Sequence[str]) -> str:
    """Several words as a sentence has them."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def plural(count: int, noun: str) -> str:
    """A number of things."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def sentence(text: str) -> str:
    """A text with a capital and a full stop, as a warning is shown."""
    text = text.strip()
    return capital(text) + ("" if text.endswith((".", "!", "?")) else ".")


def capital(text: str) -> str:
    """A text with a capital, unless it begins with a name of the code."""
    return text if "_" in text.partition(" ")[0] else text[:1].upper() + text[1:]


def settings(values: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Nested settings as names with dots and values."""
    return tuple((name, plain(value)) for name, value in named_settings(values))


def plain(value: Any) -> str:
    """A value of a JSON as a page shows it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    if isinstance(value, list):
        return ", ".join(map(plain, value)) or "none"
    return str(value)


def shared(several: Iterable[Mapping[str, Any]]) -> tuple[tuple[str, str], ...]:
    """The settings of several attacks: what all share, and the values of what differs."""
    values: dict[str, dict[str, None]] = {}
    for attack in several:
        for name, value in settings(attack):
            values.setdefault(name, {})[value] = None
    return tuple(
        (name, "; ".join([*list(different)[:MOST_VALUES], *([f"and {more} more"] if more > 0 else [])]))
        for name, different in values.items()
        for more in [len(different) - MOST_VALUES]
    )


def versions_of(result: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Packages, variant and commit of a result, as far as it names them."""
    packages = {str(name): str(version) for name, version in result.get("versions", {}).items()}
    more = {name: plain(result[name]) for name in ("variant", "commit") if result.get(name) is not None}
    return tuple({**packages, **more}.items())
