"""Integrators of Mitsuba are rewritten once in a process, and not at each change of the
variant.
"""

from collections.abc import Callable
from typing import Any

import drjit


def rewrite_once() -> None:
    """At each change to an LLVM variant Mitsuba loads its integrators again, and Dr.Jit
    rewrites them, for 0.1 s.

    A module that is loaded again keeps its names, so what was rewritten at first does
    as well.
    """
    rewrite = drjit.syntax
    done: dict[tuple[str, str], Callable[..., Any]] = {}

    def syntax(function: Callable[..., Any] | None = None, **how: Any) -> Any:
        code = getattr(function, "__code__", None)
        if function is None or code is None or how or "mitsuba" not in code.co_filename:
            return rewrite(function, **how)
        key = (code.co_filename, function.__qualname__)
        if key not in done:
            done[key] = rewrite(function)
        return done[key]

    drjit.syntax = syntax
