"""The reference of the Mitsuba plug-ins names each plug-in and each parameter, with the
default that holds, and its examples load.
"""

from __future__ import annotations

import importlib
import re
import runpy
from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import pytest

from mi_splat.attributes import ATTRIBUTES
from mi_splat.render import plugins, variant
from mi_splat.render.plugins import ray, shape, tile
from tests.project.layers import ROOT

SECTIONS = runpy.run_path(
    str(ROOT / "docs" / "sphinx_extensions" / "plugin_sections.py")
)
PAGE = ROOT / "docs" / "reference" / "mitsuba.md"
MODULES: dict[str, str] = SECTIONS["MODULES"]
PATHS = {"max_depth", "rr_depth", "hide_emitters"}
"""Parameters that `splat_ray` has from Mitsuba's path tracers."""
READ = {
    "gaussians": {"filename", "to_world", shape._PASSED_ON[0], *ATTRIBUTES},
    "splat_tile": set(tile._SETTINGS),
    "splat_ray": set(ray._SETTINGS) | PATHS,
}
"""What a plug-in reads of its properties."""


def table(name: str) -> Iterator[list[str]]:
    """The rows of the parameter table of a docstring."""
    text = str(importlib.import_module(MODULES[name]).__doc__)
    body = re.split(r"^=+(?: +=+)+$", text, flags=re.MULTILINE)[2]
    for line in body.splitlines():
        if line and not line.startswith(" "):
            yield re.split(r" {2,}", line)


def scene_with(**integrator: Any) -> Any:
    return mi.load_dict({"type": "scene", "integrator": integrator})


def written(value: Any) -> str:
    """A value as the tables have it."""
    if isinstance(value, tuple):
        return ", ".join(f"{part:g}" for part in value)
    return str(value).lower()


@pytest.fixture(autouse=True)
def _variant() -> None:
    variant.use("llvm_ad_rgb")


def test_every_registered_plugin_is_on_the_page(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    registered = []
    for function in ("register_shape", "register_integrator"):
        monkeypatch.setattr(mi, function, lambda name, _: registered.append(name))
    plugins._register_in.__wrapped__("llvm_ad_rgb")
    fence = PAGE.read_text().partition("```mitsuba-plugin\n")[2].partition("```")[0]
    assert sorted(registered) == sorted(fence.split()) == sorted(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_every_parameter_is_in_the_table(name: str) -> None:
    named = {row[0].rstrip(", .") for row in table(name)}
    assert named == READ[name]


@pytest.mark.parametrize("name", ["splat_tile", "splat_ray"])
def test_defaults_are_those_of_the_table(name: str) -> None:
    integrator = scene_with(type=name).integrator()
    for parameter, _, default, *_ in table(name):
        if parameter == "near":  # follows the scene
            continue
        if parameter == "hide_emitters":
            value = integrator._hide
        else:
            value = getattr(integrator, parameter)
        assert written(value) == default


@pytest.mark.parametrize("name", MODULES)
def test_xml_and_dict_are_one_example(name: str) -> None:
    text = SECTIONS["section"](name)
    entry = SECTIONS["dict_of"](name)
    assert SECTIONS["xml_of"](name) in text
    assert entry in text
    source = entry.replace("scenes/", f"{ROOT}/scenes/")
    example = eval(f"{{{source}}}")
    from_dict = mi.traverse(mi.load_dict({"type": "scene", **example}))
    from_xml = mi.traverse(SECTIONS["loaded"](name))
    key = next(iter(example))
    compared = [one for one in from_xml.properties if one.startswith(f"{key}.")]
    assert compared
    for parameter in compared:
        assert str(from_dict[parameter]) == str(from_xml[parameter])
        assert f"| `{parameter}` |" in text
    for parameter in example[key]:
        assert parameter == "type" or parameter in READ[name]
