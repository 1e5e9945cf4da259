"""The public API: few names, each documented where its reader looks, and what it
returns said by `help()`.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import attacks
import mi_splat
from tests.project.layers import PACKAGES, ROOT

NAMES = [(package, name) for package in (mi_splat, attacks) for name in package.__all__]
IDS = [f"{package.__name__}.{name}" for package, name in NAMES]
MOST = 45
"""Names that a reader may be asked to know."""


def functions(value: Any) -> Iterator[Callable[..., Any]]:
    """A function itself; of a class its public methods, each where a class of this
    project first declares it.
    """
    if inspect.isfunction(value):
        yield value
    for kind in value.__mro__ if inspect.isclass(value) else ():
        for name, member in (
            vars(kind).items() if kind.__module__.startswith(PACKAGES) else ()
        ):
            member = getattr(member, "__func__", member)
            first = not any(name in vars(base) for base in kind.__mro__[1:])
            if (
                first
                and inspect.isfunction(member)
                and (name == "__call__" or not name.startswith("_"))
            ):
                yield member


def test_the_names_are_few_and_each_is_there_once() -> None:
    names = [name for _, name in NAMES]
    assert len(names) == len(set(names)) <= MOST
    for package in (mi_splat, attacks):
        assert package.__all__ == sorted(
            package.__all__, key=lambda name: (name[0].islower(), name)
        )


def explained(name: str, text: str) -> bool:
    """Whether a docstring has a line for a parameter or an attribute, alone or together
    with others.
    """
    return (
        re.search(
            rf"^    (\w+, )*\*{{0,2}}{name}(, \w+)*: \S", text, flags=re.MULTILINE
        )
        is not None
    )


@pytest.mark.parametrize(("package", "name"), NAMES, ids=IDS)
def test_every_parameter_and_attribute_is_explained(package: Any, name: str) -> None:
    value = getattr(package, name)
    for function in functions(value):
        given = [
            each
            for each in inspect.signature(function).parameters
            if each not in ("self", "cls")
        ]
        missing = [
            each
            for each in given
            if not explained(each, inspect.getdoc(function) or "")
        ]
        assert not missing, f"{function.__qualname__}: {', '.join(missing)}"
    if dataclasses.is_dataclass(value):
        kinds = value.__mro__ if inspect.isclass(value) else ()
        texts = "\n".join(inspect.cleandoc(kind.__doc__ or "") for kind in kinds)
        missing = [
            each.name
            for each in dataclasses.fields(value)
            if not explained(each.name, texts)
        ]
        assert not [each for each in missing if not each.startswith("_")], (
            f"{name}: {', '.join(missing)}"
        )
    for kind in value.__mro__ if inspect.isclass(value) else ():
        for each, member in (
            vars(kind).items() if kind.__module__.startswith(PACKAGES) else ()
        ):
            assert (
                each.startswith("_")
                or not isinstance(member, property)
                or member.__doc__
            ), f"{name}.{each}"


@pytest.mark.parametrize(("package", "name"), NAMES, ids=IDS)
def test_every_name_is_documented(package: Any, name: str) -> None:
    page = (ROOT / "docs" / "api.md").read_text()
    table = page[page.index(f"| from `{package.__name__}`") :]
    assert re.search(rf"^\| .*`{name}`.* \| \S", table, flags=re.MULTILINE), (
        f"docs/api.md has no row for {name}"
    )
    value = getattr(package, name)
    text = inspect.getdoc(value) or ""
    assert text.split("\n\n")[0].endswith((".", ":"))
    for function in functions(value):
        returned = inspect.signature(function).return_annotation
        if returned in (None, "None", inspect.Signature.empty):
            continue
        told = inspect.getdoc(function) or ""
        assert re.search(r"^(Returns|Yields):$", told, flags=re.MULTILINE), (
            f"{function.__qualname__} -> {returned}"
        )


def test_the_page_names_nothing_else() -> None:
    page = (ROOT / "docs" / "api.md").read_text()
    for package in (mi_splat, attacks):
        table = page[page.index(f"| from `{package.__name__}`") :].split("\n\n")[0]
        named = {
            name
            for row in table.splitlines()[2:]
            for name in re.findall(r"`(\w+)`", row.split(" | ")[0])
        }
        assert named == {*package.__all__}
