"""A name that packages export is documented once: by the outermost package that exports
it, not again in its module.
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

PACKAGES = (
    *("mi_splat", "attacks"),
    *(
        "mi_splat.io",
        "mi_splat.datasets",
        "mi_splat.training.strategies",
        "attacks.detectors",
    ),
    "attacks.testing",
)
"""Packages with a page that export names of their modules, the outer ones first."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("autodoc-skip-member", skip_exported)
    python: Any = importlib.import_module("sphinx.domains.python")
    for field in python.PyObject.doc_field_types:
        if field.name == "variable":
            # as the docstrings have it; Sphinx says "Variables"
            field.label = "Attributes"
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def skip_exported(
    app: Sphinx, what: str, name: str, member: Any, skip: bool, options: Any
) -> bool | None:
    """Whether a member of a module is left out, for the page of a package has it; None
    if others shall decide.
    """
    if what != "module":
        return None
    owner = next(
        (
            package
            for package in PACKAGES
            if exports(package).get(name, exports) is member
        ),
        None,
    )
    if owner in (None, app.env.current_document.autodoc_module):
        return None
    return True


@cache
def exports(package: str) -> dict[str, object]:
    """The public names of a package and what they stand for."""
    module = importlib.import_module(package)
    return {name: getattr(module, name) for name in module.__all__}
