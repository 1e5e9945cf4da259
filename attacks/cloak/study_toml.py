"""A study of CLOAK as the TOML file that `mi-splat cloak` reads."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any


def study_toml(snapshot: Mapping[str, Any]) -> str:
    """The file of a study; settings without a value are left out, which stands for None.

    Args:
        snapshot: The study as JSON holds it (`dataclasses.asdict`).
    """
    return "\n".join([*_lines(snapshot, ""), ""]).lstrip("\n")


def _lines(table: Mapping[str, Any], name: str) -> Iterator[str]:
    """A table: its own keys, then the tables within it."""
    inner = {key: value for key, value in table.items() if _is_table(value)}
    for key, value in table.items():
        if key not in inner and value is not None:
            yield f"{key} = {_inline(value)}"
    for key, value in inner.items():
        within = f"{name}{key}"
        for entry in value if isinstance(value, (list, tuple)) else [value]:
            yield from ("", f"[[{within}]]" if isinstance(value, (list, tuple)) else f"[{within}]")
            yield from _lines(entry, f"{within}.")


def _is_table(value: Any) -> bool:
    several = isinstance(value, (list, tuple)) and bool(value) and isinstance(value[0], Mapping)
    return several or isinstance(value, Mapping)


def _inline(value: Any) -> str:
    """A value on one line; TOML writes texts, numbers and truths as JSON does."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_inline, value))}]"
    return json.dumps(value, ensure_ascii=False)
