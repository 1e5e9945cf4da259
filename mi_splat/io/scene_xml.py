"""Scene files of Mitsuba before Mitsuba reads them: XML of sane depth and size, without inclusions in a circle.

Mitsuba's own reader follows any depth, which ends the process where the stack does, and takes any encoding.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from mi_splat.errors import InvalidValueError, message
from mi_splat.io.texture_files import check_texture

MOST_BYTES, MOST_ELEMENTS, DEEPEST = 16 << 20, 100_000, 64
"""What a scene file may have: bytes (with the files that it includes, too), elements, and elements in each other."""
MOST_INCLUSIONS, _LONGEST_CHAIN = 1000, 15
"""How many files a scene may include in all, and in a row, which is Mitsuba's own limit."""
_ENCODING = re.compile(r"\s*<\?xml[^>]*?encoding\s*=\s*[\"']([^\"']*)")
_PICTURES = (".bmp", ".exr", ".hdr", ".jpeg", ".jpg", ".pfm", ".png", ".ppm", ".rgbe", ".tga", ".tif", ".tiff", ".webp")


def scene_elements(path: Path) -> list[ElementTree.Element]:
    """All elements of a scene file in their order, of those that it includes none.

    Raises:
        InvalidValueError: The file cannot be read, is no XML in UTF-8, defines entities, or has too many elements or
            too many in each other.
    """
    try:
        if (size := path.stat().st_size) > MOST_BYTES:
            raise ValueError(f"{size:,} bytes, more than {MOST_BYTES:,}")
        text = path.read_bytes().decode("utf-8-sig")
        declared = _ENCODING.match(text)
        if declared and declared[1].lower() not in ("utf-8", "utf8", "us-ascii", "ascii"):
            raise ValueError(f"the encoding {declared[1]}, and not UTF-8")
        builder = _Bounded()
        parser = ElementTree.XMLParser(target=builder, encoding="utf-8")
        parser.feed(text.encode())
        parser.close()
    except (OSError, ValueError, ElementTree.ParseError) as error:
        do = "check the path" if isinstance(error, OSError) else "mend the file"
        raise InvalidValueError(message(f"scene {path}", "a Mitsuba XML file", str(error), do)) from error
    return builder.elements


class _Bounded(ElementTree.TreeBuilder):
    """Builds a tree, and raises ValueError for one that is too deep or too large or has entities of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.elements: list[ElementTree.Element] = []
        self._depth = 0

    def start(self, tag: str, attributes: dict[str, str]) -> ElementTree.Element:
        """An element begins."""
        self._depth += 1
        if self._depth > DEEPEST:
            raise ValueError(f"more than {DEEPEST} elements in each other")
        if len(self.elements) >= MOST_ELEMENTS:
            raise ValueError(f"more than {MOST_ELEMENTS:,} elements")
        self.elements.append(super().start(tag, attributes))
        return self.elements[-1]

    def end(self, tag: str) -> ElementTree.Element:
        """An element ends."""
        self._depth -= 1
        return super().end(tag)

    def doctype(self, name: str, public: str | None, system: str | None) -> None:
        """A document type, in which entities may be defined."""
        raise ValueError("a document type (DOCTYPE), which no scene needs")


def check_scene_file(path: Path, parameters: Mapping[str, object] | None = None) -> None:
    """Raise unless Mitsuba may read a scene file, the files that it includes and the pictures that they name.

    Args:
        path: The scene file.
        parameters: Values that take the place of its defaults.

    Raises:
        InvalidValueError: A file cannot be read, is no XML in UTF-8, defines entities or includes itself, or there are
            too many elements, too many in each other, or too many inclusions, or parameters make their texts too long.
        PictureFileError: A picture has too many pixels.
    """
    what, texts, included = f"scene {path}", _Texts(parameters or {}), 0
    waiting: list[tuple[Path, tuple[Path, ...]]] = [(path, ())]
    while waiting:
        file, including = waiting.pop()
        chain = (*including, file.resolve())
        if chain[-1] in including or len(chain) > _LONGEST_CHAIN + 1:
            names = " includes ".join(one.name for one in chain)
            raise InvalidValueError(message(what, "files that end somewhere", names, "remove the circle"))
        included += 1
        if included > MOST_INCLUSIONS:
            expected = f"at most {MOST_INCLUSIONS:,} inclusions"
            raise InvalidValueError(message(what, expected, "more", "write what they hold into one file"))
        places = dict.fromkeys([file.parent.resolve(), path.parent.resolve(), Path().resolve()])
        for element in scene_elements(file):
            name = texts.filled(element, what)
            found = [
                place / name for place in places if name and os.path.exists(place / name)
            ]  # of names of any length
            named = dict.fromkeys(one.resolve() for one in found)
            if element.tag == "path":
                places |= named
            elif element.tag == "include":
                waiting += [(one, chain) for one in named if one.is_file()]
            for picture in (one for one in named if one.suffix.lower() in _PICTURES and one.is_file()):
                check_texture(picture)


class _Texts:
    """The texts of elements, with the values of parameters in the place of their names."""

    def __init__(self, parameters: Mapping[str, object]) -> None:
        self._values = {name: str(value) for name, value in parameters.items()}
        self._longest = max(map(len, self._values.values()), default=0)
        self._size = 0

    def filled(self, element: ElementTree.Element, what: str) -> str:
        """The file that an element may name; what it says of a parameter is known from then on.

        Args:
            element: The next element.
            what: The scene, for messages.

        Raises:
            InvalidValueError: All texts together may be too long, as where parameters repeat each other.
        """
        self._size += sum(len(text) + text.count("$") * self._longest for text in element.attrib.values())
        if self._size > MOST_BYTES:
            expected = f"at most {MOST_BYTES:,} characters, with the values of parameters"
            raise InvalidValueError(message(what, expected, "more", "write less into <default>"))
        text = element.get("filename" if element.tag == "include" else "value", "")
        found = re.sub(r"\$(\w+)", lambda part: self._values.get(part[1], part[0]), text)
        if element.tag == "default":
            self._values.setdefault(element.get("name", ""), found)
            self._longest = max(self._longest, len(found))
        return found if element.tag in ("path", "include", "string") else ""
