"""What a Mitsuba scene is made of: the elements of its file and of those that it
includes, and the files they name.

A file is read before Mitsuba reads it: XML in UTF-8 of sane depth and size, without
entities. Mitsuba's own reader follows any depth, which ends the process where the stack
does, and takes any encoding. It also loads native code for a plugin type that it does
not know, and reads from any device: both are refused here.
"""

import functools
import importlib.util
import os
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from mi_splat.errors import InvalidValueError, one_line
from mi_splat.io.mesh_sizes import stated_bytes
from mi_splat.io.picture_files import check_texture, is_texture

MOST_BYTES = 16 << 20
MOST_ELEMENTS = 100_000
DEEPEST = 64
"""What a scene file may have: bytes and elements (with the files that it includes,
too), and elements in each other.
"""
OWN_PLUGINS = ("gaussians", "splat_ray", "splat_tile")
"""The plugins of this library, which `mi_splat.render.plugins` registers."""
_ENCODING = re.compile(r"\s*<\?xml[^>]*?encoding\s*=\s*[\"']([^\"']*)")


@functools.cache
def plugin_names() -> frozenset[str]:
    """The plugin types that a scene may name: those that Mitsuba ships, native or in
    Python, and our own.
    """
    spec = importlib.util.find_spec("mitsuba")
    package = Path(spec.origin).parent if spec is not None and spec.origin else Path()
    files = [*package.glob("plugins/*"), *package.glob("python/ad/integrators/*.py")]
    return frozenset(
        {*OWN_PLUGINS, *(file.stem for file in files)} - {"__init__", "common"}
    )


def scene_elements(path: Path) -> list[ElementTree.Element]:
    """All elements of a scene file in their order, of those that it includes none."""
    try:
        if path.exists() and not path.is_file():
            raise ValueError("a folder, a device or a pipe")
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise ValueError(f"{size:,} bytes, more than {MOST_BYTES:,}")
        text = path.read_bytes().decode("utf-8-sig")
        declared = _ENCODING.match(text)
        if declared and declared[1].lower() not in (
            "utf-8",
            "utf8",
            "us-ascii",
            "ascii",
        ):
            raise ValueError(f"the encoding {declared[1]}, and not UTF-8")
        builder = _Bounded()
        parser = ElementTree.XMLParser(target=builder, encoding="utf-8")
        parser.feed(text.encode())
        parser.close()
    except (OSError, ValueError, ElementTree.ParseError) as error:
        do = "check the path" if isinstance(error, OSError) else "mend the file"
        raise InvalidValueError.of(
            f"scene {path}", "a Mitsuba XML file", str(error), do
        ) from error
    return builder.elements


class _Bounded(ElementTree.TreeBuilder):
    """Builds a tree, and raises ValueError for one that is too deep or too large or has
    entities of its own.
    """

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


MOST_INCLUSIONS = 1000
_MOST_FOLDERS = 64
"""How many files a scene may include, and in how many folders it may have them looked
for.
"""
MOST_NAMED_BYTES = 2_000_000_000
"""What the meshes, images and splats that a scene names may hold, unpacked, a file that
is named twice twice.
"""
_LONGEST_CHAIN = 16
"""Files that include each other in a row; Mitsuba refuses more."""
_NATIVE = (".dll", ".dylib", ".so")
_PICTURES = (
    ".bmp",
    ".exr",
    ".hdr",
    ".jpeg",
    ".jpg",
    ".pfm",
    ".png",
    ".ppm",
    ".rgbe",
    ".tga",
    ".tif",
    ".tiff",
    ".webp",
)


class SceneParts:
    """The elements of a scene, parameters filled in, and the scene file with every file
    that an element names.

    A file is looked for where Mitsuba does: in the folders that <path> elements name,
    beside the scene file, then in the working folder; one that is included, before that
    beside the file that includes it. What meshes name is left out, since Mitsuba reads
    no material of them.
    """

    def __init__(
        self, path: Path, parameters: Mapping[str, object] | None = None
    ) -> None:
        self.elements: list[Element] = []
        self.files = [path]
        self._scene = f"scene {path}"
        self._values = {name: str(value) for name, value in (parameters or {}).items()}
        self._longest = max(map(len, self._values.values()), default=0)
        self._size = 0
        self._included = 0
        self._folders = [path.parent, Path()]
        self._read(path, [path.resolve()])

    def check(self) -> None:
        """Raise unless Mitsuba may read the images and meshes that it names, and loads
        no code from its folders.
        """
        # without the working folder, where Mitsuba looks last
        for folder in self._folders[:-1]:
            for file in folder.glob("plugins/*"):
                if (
                    file.stem in plugin_names() - set(OWN_PLUGINS)
                    and file.suffix in _NATIVE
                ):
                    raise self._refused(
                        "no native code next to it", f"{file}", "remove that file"
                    )
        total = 0
        for file, times in Counter(self.files[1:]).items():
            if file.suffix.lower() in _PICTURES or is_texture(file):
                check_texture(file)
            # Mitsuba reads a file again for each element that names it.
            total += times * stated_bytes(file)
            if total > MOST_NAMED_BYTES:
                expected = (
                    f"files that hold at most {MOST_NAMED_BYTES:,} bytes in all,"
                    " unpacked"
                )
                raise self._refused(
                    expected,
                    f"more with {one_line(str(file), 200)}",
                    "split the scene, or its meshes",
                )

    def _read(self, path: Path, chain: list[Path]) -> None:
        """Add the elements of a file that was included by way of others, and the files
        that they name.
        """
        for element in scene_elements(path):
            filled = self._filled(element)
            self.elements.append(Element(element.tag, filled))
            kind = filled.get("type")
            if kind is not None and kind not in plugin_names():
                got = f'type="{one_line(kind, 60)}" in <{element.tag}>'
                raise self._refused(
                    "plugins that Mitsuba or mi-splat ships", got, "take another plugin"
                )
            if len(self.elements) > MOST_ELEMENTS:
                raise self._refused(
                    f"at most {MOST_ELEMENTS:,} elements in all",
                    "more",
                    "split the scene",
                )
            if element.tag == "default":
                self._values.setdefault(filled.get("name", ""), filled.get("value", ""))
                self._longest = max(self._longest, len(filled.get("value", "")))
            elif element.tag == "path":
                named = [folder / filled.get("value", "") for folder in self._folders]
                self._folders[:0] = [
                    folder for folder in named if os.path.isdir(folder)
                ][:1]
                if len(self._folders) > _MOST_FOLDERS:
                    raise self._refused(
                        f"at most {_MOST_FOLDERS} folders to look in",
                        "more",
                        "write fewer <path>",
                    )
            else:
                name = filled.get(
                    "value" if element.tag == "string" else "filename", ""
                )
                folders = [path.parent] * (element.tag == "include") + self._folders
                named = [folder / name for folder in folders]
                # of names of any length
                files = [file for file in named if os.path.isfile(file)]
                if not files and any(
                    os.path.exists(file) and not os.path.isdir(file) for file in named
                ):
                    raise self._refused(
                        "names of regular files",
                        f"{one_line(name, 60)}, a device or a pipe",
                        "name another file",
                    )
                self.files += files[:1]
                if files and element.tag == "include":
                    self._include(files[0], chain)

    def _include(self, file: Path, chain: list[Path]) -> None:
        inner = [*chain, file.resolve()]
        self._included = self._included + 1
        if inner[-1] in chain or len(inner) > _LONGEST_CHAIN:
            names = " includes ".join(path.name for path in inner)
            raise self._refused("files that end somewhere", names, "remove the circle")
        if self._included > MOST_INCLUSIONS:
            raise self._refused(
                f"at most {MOST_INCLUSIONS:,} inclusions",
                "more",
                "write what they hold into one file",
            )
        self._read(file, inner)

    def _filled(self, element: Element) -> dict[str, str]:
        """The attributes of an element with the values of parameters in the place of
        their names.
        """
        self._size += sum(
            len(text) + text.count("$") * self._longest
            for text in element.attrib.values()
        )
        if self._size > MOST_BYTES:
            expected = (
                f"at most {MOST_BYTES:,} characters, with the values of parameters"
            )
            raise self._refused(expected, "more", "write less into <default>")
        # As Mitsuba does it: the longest name that fits, whatever stands behind it.
        names = sorted(filter(None, self._values), key=len, reverse=True)
        if not names:
            return dict(element.items())
        known = re.compile(r"\$(" + "|".join(map(re.escape, names)) + ")")
        return {
            key: known.sub(lambda part: self._values[part[1]], text)
            for key, text in element.items()
        }

    def _refused(self, expected: str, got: str, do: str) -> InvalidValueError:
        return InvalidValueError.of(self._scene, expected, got, do)
