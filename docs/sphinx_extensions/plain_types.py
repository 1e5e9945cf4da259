"""A signature names the types of its parameters alone.

Their ranges stand on the pages of commands, and in errors.

The value of a constant is shown where it is short, and no path: that would be one of
the machine that builds the site.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, get_type_hints

if TYPE_CHECKING:
    from docutils.nodes import document
    from sphinx.application import Sphinx

LONGEST = 72
"""Signs of a value that is shown."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-before-process-signature", without_ranges)
    app.connect("doctree-read", without_long_values)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def without_ranges(app: Sphinx, function: Any, bound: bool) -> None:
    """Take from a function's annotations what `Annotated` adds: Sphinx writes it so
    that it cannot read it again.
    """
    function = getattr(function, "__func__", function)
    if "Annotated" not in str(getattr(function, "__annotations__", "")):
        return
    try:
        function.__annotations__ = get_type_hints(function)
    except NameError:  # of a type that is imported for type checkers alone
        return


def without_long_values(app: Sphinx, doctree: document) -> None:
    """Take the values of constants away that are longer than a line, or a path."""
    from sphinx.addnodes import desc_annotation

    for annotation in list(doctree.findall(desc_annotation)):
        text = annotation.astext().strip()
        if text.startswith("=") and (len(text) > LONGEST or "Path(" in text):
            annotation.parent.remove(annotation)
