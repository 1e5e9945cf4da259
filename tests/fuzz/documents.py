"""The JSON inside of files."""

import io
import json
import re
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import escape


@dataclass(frozen=True, slots=True)
class Document:
    """Where a file has JSON: `get` takes the document out, `put` makes the file with another one."""

    get: Callable[[bytes], Any]
    put: Callable[[bytes, str], bytes]


PLAIN_JSON = Document(json.loads, lambda data, text: text.encode("utf-8", "surrogatepass"))
"""A file that is one document."""


def _with_glb_json(data: bytes, text: str) -> bytes:
    part = text.encode("utf-8", "surrogatepass")
    part += b" " * (-len(part) % 4)
    body = struct.pack("<I4s", len(part), b"JSON") + part + data[20 + struct.unpack_from("<I", data, 12)[0] :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def _sog_json(data: bytes) -> Any:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return json.loads(archive.read("meta.json"))


def _with_sog_json(data: bytes, text: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(buffer, "w") as other:
        for name in archive.namelist():
            part = text.encode("utf-8", "surrogatepass") if name == "meta.json" else archive.read(name)
            other.writestr(name, part)
    return buffer.getvalue()


def _header(data: bytes) -> Any:
    return json.loads(data[8 : 8 + struct.unpack_from("<Q", data)[0]])


def _with_header(data: bytes, text: str) -> bytes:
    part = text.encode("utf-8", "surrogatepass")
    return struct.pack("<Q", len(part)) + part + data[8 + struct.unpack_from("<Q", data)[0] :]


def _notes(data: bytes) -> Any:
    return json.loads(_header(data)["__metadata__"]["notes"])


def _with_notes(data: bytes, text: str) -> bytes:
    return _with_header(data, json.dumps({**_header(data), "__metadata__": {"notes": text}}))


CHECKPOINT = Document(_notes, _with_notes)
SAFETENSORS = Document(_header, _with_header)

GLB = Document(lambda data: json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]]), _with_glb_json)
SOG = Document(_sog_json, _with_sog_json)

_NAMED = re.compile(r'(?<= type=")[^"]*|(?<= value=")[^"]*\.ply')
_NOT_FOR_SCENES = ("evil", "../evil", "plugins/evil", "/dev/zero", "pipe", ".")


def _with_names(data: bytes, text: str) -> bytes:
    try:
        names = iter([str(name) for name in json.loads(text)["scene"]])
    except (ValueError, TypeError, KeyError, RecursionError):
        names = iter([text])
    xml = _NAMED.sub(lambda match: escape(next(names, match[0]), {'"': "&quot;"}), data.decode())
    return xml.encode("utf-8", "surrogatepass")


SCENE_NAMES = Document(
    lambda data: {"scene": _NAMED.findall(data.decode())[:6], "others": [*_NOT_FOR_SCENES]}, _with_names
)
"""The first plugin types and splats that a scene file names, beside names that no scene may have."""
