"""One scene file of Mitsuba before Mitsuba reads it: XML in UTF-8 of sane depth and size, without entities.

Mitsuba's own reader follows any depth, which ends the process where the stack does, and takes any encoding.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

from mi_splat.errors import InvalidValueError

MOST_BYTES, MOST_ELEMENTS, DEEPEST = 16 << 20, 100_000, 64
"""What a scene file may have: bytes and elements (with the files that it includes, too), and elements in each other."""
_ENCODING = re.compile(r"\s*<\?xml[^>]*?encoding\s*=\s*[\"']([^\"']*)")


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
        raise InvalidValueError.of(f"scene {path}", "a Mitsuba XML file", str(error), do) from error
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
