"""A signature names the types of its parameters alone. Their ranges stand on the pages of commands, and in errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, get_type_hints

if TYPE_CHECKING:
    from sphinx.application import Sphinx


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-before-process-signature", without_ranges)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def without_ranges(app: Sphinx, function: Any, bound: bool) -> None:
    """Take from a function's annotations what `Annotated` adds: Sphinx writes it so that it cannot read it again."""
    function = getattr(function, "__func__", function)
    if "Annotated" not in str(getattr(function, "__annotations__", "")):
        return
    try:
        function.__annotations__ = get_type_hints(function)
    except NameError:  # of a type that is imported for type checkers alone
        return
