"""Every name of this project on docs/coming-from.md is one, with the arguments that the
page gives it.
"""

from __future__ import annotations

import importlib
import inspect
import re
from typing import Any

import pytest

import attacks
import mi_splat
from attacks.cli import COMMANDS
from attacks.optimisers import OPTIMISERS
from tests.project.layers import ROOT

PAGE = (ROOT / "docs" / "coming-from.md").read_text()
ROWS = re.findall(r"^\| `?(.+?) \| (`.+?) \|(.*)\|$", PAGE, re.MULTILINE)
OURS = sorted({code for _, ours, _ in ROWS for code in re.findall(r"`(.+?)`", ours)})
LIBRARIES = ("foolbox", "torchattacks", "ART", "gsplat", "nerfstudio")


def resolved(name: str) -> Any:
    """What a name stands for: one of the two packages, or a full path."""
    for package in (attacks, mi_splat):
        if name in package.__all__:
            return getattr(package, name)
    module, _, last = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), last)
    except ModuleNotFoundError:  # a method
        return getattr(resolved(module), last)


def test_every_library_has_its_table() -> None:
    for library in LIBRARIES:
        section = re.split(rf"^## .*{library}.*$", PAGE, flags=re.MULTILINE)[1]
        assert section.strip().startswith("| ")
    assert len(ROWS) > 30


@pytest.mark.parametrize("code", OURS)
def test_a_name_of_ours_exists(code: str) -> None:
    if code.startswith("mi-splat "):
        assert code.removeprefix("mi-splat ") in COMMANDS
        return
    if code.startswith('"'):  # the name of a condition
        resolved("attacks.observe.conditions.check_condition")(code.strip('"'), None)
        return
    name, _, arguments = code.partition("(")
    found = resolved(name)
    parameters = inspect.signature(found).parameters
    for argument in re.findall(r"\w+", arguments.partition(")")[0]):
        assert argument in parameters


def test_the_optimisers_are_those_of_the_page() -> None:
    line = next(line for line in PAGE.splitlines() if "`MIFGSM`" in line)
    named = re.findall(r"`(\w+)`", line.rpartition("|")[0].rpartition("|")[2])
    assert sorted([*named, "pgd"]) == sorted(OPTIMISERS)
