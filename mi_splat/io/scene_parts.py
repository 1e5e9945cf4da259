"""What a Mitsuba scene is made of: the elements of its file and of those that it includes, and the files they name."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, parse

from mi_splat.errors import InvalidValueError, message

_LONGEST_CHAIN = 16
"""Files that include each other in a row; Mitsuba refuses more."""


@dataclass(slots=True)
class SceneParts:
    """What a scene is made of; see `scene_parts`.

    Attributes:
        elements: All elements in their order, those of included files after their inclusion, with the values of the
            parameters in their attributes.
        files: The scene file and every file that an element names, in their order.
    """

    elements: list[Element] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)


def scene_parts(path: Path) -> SceneParts:
    """Read what a scene is made of.

    A file is looked for where Mitsuba does: in the folders that <path> elements name, beside the scene file, then in
    the working folder. What meshes name is left out, since Mitsuba reads no material of them.

    Raises:
        InvalidValueError: The scene file, or one that it includes, cannot be read.
    """
    found = SceneParts(files=[path])
    _read(path, found, values={}, places=[path.parent, Path()], chain=[path.resolve()])
    return found


def _read(path: Path, found: SceneParts, values: dict[str, str], places: list[Path], chain: list[Path]) -> None:
    """Add the elements of a file to `found`, those of its parameters to `values`, those of its paths to `places`."""
    for element in _elements(path):
        filled = {key: _filled(value, values) for key, value in element.items()}
        found.elements.append(Element(element.tag, filled))
        if element.tag == "default":
            values.setdefault(filled.get("name", ""), filled.get("value", ""))
        elif element.tag == "path":
            named = [place / filled.get("value", "") for place in places]
            places[:0] = [place for place in named if os.path.isdir(place)][:1]
        else:
            name = filled.get("value" if element.tag == "string" else "filename", "")
            files = [place / name for place in places if os.path.isfile(place / name)]  # of names of any length
            found.files += files[:1]
            inner = [file.resolve() for file in files[:1] if element.tag == "include"]
            if inner and inner[0] not in chain and len(chain) < _LONGEST_CHAIN:
                _read(files[0], found, values, places, [*chain, *inner])


def _filled(text: str, values: dict[str, str]) -> str:
    """A text with the values of parameters in the place of their names."""
    return re.sub(r"\$(\w+)", lambda part: values.get(part[1], part[0]), text)


def _elements(path: Path) -> Iterable[Element]:
    """The elements of one file."""
    try:
        return parse(path).iter()
    except (OSError, ParseError) as error:
        raise InvalidValueError(message(f"scene {path}", "a Mitsuba XML file", str(error), "check the path")) from error
