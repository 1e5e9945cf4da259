"""Damages files: bytes, words, and the structure of JSON inside of them; the same for the same random numbers."""

import copy
import io
import json
import re
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
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


RAW = "@raw@"
"""Stands before what is to be in the JSON as it is."""
_PLAIN = '[null,true,0,-1,1,3,0.5,1e300,2147483648,4611686018427387904,"","x","\\u0000","../../x","1"'
_PLAIN += ',[],{},[[]],[0],{"a":1}]'
VALUES: tuple[Any, ...] = (
    *json.loads(_PLAIN),
    *(f"{RAW}NaN", f"{RAW}-Infinity", f"{RAW}1e999", f"{RAW}{'9' * 10_000}", f'{RAW}"\\ud800"'),
    *(f"{RAW}{1 << 64}", f"{RAW}{'[' * 70}{']' * 70}", f"{RAW}{'[' * 5000}{']' * 5000}", f'{RAW}{{"a":1,"a":2}}'),
)
WORDS = b'NaN inf -1 0 1e999 1e-320 99999999999999999999 [] {} "" \xff true'.split()
_WORD = re.compile(rb'-?\d[\d.eE+-]*|"[^"\n]*"|[A-Za-z_]+')
_RAW = re.compile(rf'"{RAW}((?:[^"\\]|\\.)*)"')


def mutant(data: bytes, random: Random, document: Document | None) -> bytes:
    """A damaged file; `document` says where it has JSON, None if it has none."""
    if document is not None and random.random() < 0.7:
        values = copy.deepcopy(document.get(data))
        for _ in range(random.choice((1, 1, 1, 2, 4))):
            values = _changed(values, random)
        return document.put(data, text_of(values))
    change = random.choice((_flipped, _flipped, _cut, _spliced, _numbered, _reworded, _reworded))
    return change(data, random)


def text_of(values: Any) -> str:
    """JSON of values, some of which are put into it as they are."""
    return _RAW.sub(lambda match: json.loads(f'"{match[1]}"'), json.dumps(values))


def _changed(values: Any, random: Random) -> Any:
    """The values with one of them changed: taken out, doubled, moved, or replaced."""
    slots = list(_slots(values))
    if not slots:
        return random.choice(VALUES)
    holder, key = random.choice(slots)
    match random.randrange(5):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, list):
            holder.insert(key, copy.deepcopy(holder[key]))
        case 2:
            other, slot = random.choice(slots)
            holder[key] = copy.deepcopy(other[slot])
        case 3 if isinstance(holder, dict):
            holder["more"] = holder.pop(key)
        case _:
            holder[key] = copy.deepcopy(random.choice(VALUES))
    return values


def _slots(values: Any) -> Any:
    """Every object or list with each of its keys; of long lists the first few."""
    keys = list(values) if isinstance(values, dict) else range(min(len(values), 6)) if isinstance(values, list) else ()
    for key in keys:
        yield values, key
        yield from _slots(values[key])


def _flipped(data: bytes, random: Random) -> bytes:
    flipped = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 8))):
        flipped[random.randrange(len(flipped))] ^= 1 << random.randrange(8)
    return bytes(flipped)


def _cut(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data))]


def _spliced(data: bytes, random: Random) -> bytes:
    start, other, length = random.randrange(len(data)), random.randrange(len(data)), random.randrange(1, 64)
    return data[:start] + data[other : other + length] + data[start + random.choice((0, length)) :]


def _numbered(data: bytes, random: Random) -> bytes:
    form, value = random.choice(
        (("<I", 0), ("<I", 0xFFFFFFFF), ("<I", 1 << 30), ("<f", float("nan")), ("<f", float("inf")), ("<Q", 1 << 40))
    )
    offset, part = random.randrange(len(data)), struct.pack(form, value)
    return data[:offset] + part + data[offset + len(part) :]


def _reworded(data: bytes, random: Random) -> bytes:
    """A number, a name or a quoted text in the first bytes replaced."""
    words = list(_WORD.finditer(data[:20_000]))
    if not words:
        return _flipped(data, random)
    word_before, word = random.choice(words), random.choice(WORDS)
    if word_before[0].startswith(b'"') and random.random() < 0.7:
        word = b'"' + word.strip(b'"') + b'"'
    return data[: word_before.start()] + word + data[word_before.end() :]
