"""The reference of the Mitsuba plug-ins, in the form of Mitsuba's own: what a plug-in
does, its parameters, an example in XML and as a dict, and what `mi.traverse` shows.

Description and parameters are those of the docstrings; XML and dict are written from
one example, which is loaded to see what `mi.traverse` shows of it. A fence
`mitsuba-plugin` on a page lists the plug-ins that it describes.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

MODULES = {
    "gaussians": "mi_splat.render.plugins.shape",
    "splat_tile": "mi_splat.render.plugins.tile",
    "splat_ray": "mi_splat.render.plugins.ray",
}
"""The module whose docstring describes a plug-in."""
EXAMPLES: Mapping[str, Mapping[str, Any]] = {
    "gaussians": {"id": "car", "filename": "scenes/car_street_car.ply"},
    "splat_tile": {"background": (0.55, 0.72, 0.9), "antialiased": True},
    "splat_ray": {"max_depth": 8, "hide_emitters": True},
}
"""Parameters of the example of a plug-in."""

_FENCE = re.compile(r"^```mitsuba-plugin\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_TAGS = {bool: "boolean", int: "integer", float: "float", str: "string", tuple: "rgb"}
_SCENES = Path(__file__).resolve().parents[2] / "scenes"


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", expand)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def expand(app: Sphinx, docname: str, source: list[str]) -> None:
    """Put the sections of the plug-ins in the place of their names."""
    source[0] = _FENCE.sub(
        lambda fence: "\n".join(map(section, fence[1].split())), source[0]
    )


def section(name: str) -> str:
    """The section of one plug-in, in Markdown."""
    module = importlib.import_module(MODULES[name])
    lines = [
        f"## {kind_of(name).capitalize()} `{name}`",
        "",
        "```{eval-rst}",
        inspect.cleandoc(str(module.__doc__)),
        "```",
        "",
        *tabs(name, xml_of(name), dict_of(name)),
        "",
        "`mi.traverse` of a scene with this example shows:",
        "",
        "| parameter | type | differentiable |",
        "|---|---|---|",
        *traversed(name),
        "",
    ]
    return "\n".join(lines)


def kind_of(name: str) -> str:
    """What a plug-in is in a scene."""
    if name == "gaussians":
        return "shape"
    return "integrator"


def xml_of(name: str) -> str:
    """The example of a plug-in in XML."""
    given = dict(EXAMPLES[name])
    kind, attributes = kind_of(name), ""
    if "id" in given:
        attributes = f' id="{given.pop("id")}"'
    lines = [f'<{kind} type="{name}"{attributes}>']
    for key, value in given.items():
        lines.append(f'    <{_TAGS[type(value)]} name="{key}" value="{_text(value)}"/>')
    return "\n".join([*lines, f"</{kind}>"])


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return str(value)


def dict_of(name: str) -> str:
    """The example of a plug-in as an entry of a scene dict, in Python."""
    given = dict(EXAMPLES[name])
    key = given.pop("id", kind_of(name))
    lines = [f'"{key}": {{', f'    "type": "{name}",']
    for parameter, value in given.items():
        if isinstance(value, tuple):
            colour = ", ".join(map(str, value))
            lines.append(f'    "{parameter}": {{"type": "rgb", "value": [{colour}]}},')
        elif isinstance(value, str):
            lines.append(f'    "{parameter}": "{value}",')
        else:
            lines.append(f'    "{parameter}": {value},')
    return "\n".join([*lines, "},"])


def tabs(name: str, xml: str, entry: str) -> Iterator[str]:
    """Two blocks of which one is shown at a time; site.css hides the other."""
    yield from ("::::{container} tabs", "```{raw} html")
    for number, label in enumerate(("XML", "dict")):
        checked = " checked" * (number == 0)
        yield (
            f'<input type="radio" name="{name}" id="{name}-{label}"{checked}>'
            f'<label for="{name}-{label}">{label}</label>'
        )
    yield "```"
    for language, text in (("xml", xml), ("python", entry)):
        yield from (":::{container} tab", f"```{language}", text, "```", ":::")
    yield "::::"


def traversed(name: str) -> Iterator[str]:
    """Rows of what `mi.traverse` shows of the example of a plug-in."""
    import drjit as dr
    import mitsuba as mi

    parameters = mi.traverse(loaded(name))
    key = EXAMPLES[name].get("id", kind_of(name))
    for parameter, (_, _, _, flags) in parameters.properties.items():
        if parameter.startswith(f"{key}."):
            value = parameters[parameter]
            is_fixed = bool(flags & mi.ParamFlags.NonDifferentiable.value)
            is_array = dr.is_float_v(value) and dr.is_array_v(value)
            answer = "yes" if is_array and not is_fixed else "no"
            yield f"| `{parameter}` | {type(value).__name__} | {answer} |"


def loaded(name: str) -> Any:
    """A Mitsuba scene with the example of a plug-in."""
    import mitsuba as mi

    from mi_splat.render import variant

    variant.use("llvm_ad_rgb")
    xml = xml_of(name).replace("scenes/", f"{_SCENES}/")
    return mi.load_string(f'<scene version="3.0.0">{xml}</scene>')
