"""Damages files: bytes, words, and the JSON, the archive or the packed text in them.

The same random numbers make the same damage.
"""

import copy
import gzip
import io
import json
import lzma
import re
import struct
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from typing import Any

Change = Callable[[bytes, Random], bytes]


@dataclass(frozen=True, slots=True)
class Document:
    """Where a file has JSON.

    Attributes:
        get: Takes the document out of the bytes of a file.
        put: Makes the file with another document, whose text is given.
    """

    get: Callable[[bytes], Any]
    put: Callable[[bytes, str], bytes]


@dataclass(frozen=True, slots=True)
class Packing:
    """How what a file holds is packed; damage to what is unpacked passes every
    checksum.
    """

    unpack: Callable[[bytes], bytes]
    pack: Callable[[bytes], bytes]


GZIP = Packing(gzip.decompress, lambda data: gzip.compress(data, 1, mtime=0))
XZ = Packing(lzma.decompress, lambda data: lzma.compress(data, preset=0))


def encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


# JSON inside of files


PLAIN_JSON = Document(json.loads, lambda data, text: encoded(text))
"""A file that is one document."""


def _glb_json(data: bytes) -> Any:
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length])


def _with_glb_json(data: bytes, text: str) -> bytes:
    part = encoded(text)
    part += b" " * (-len(part) % 4)
    rest = data[20 + struct.unpack_from("<I", data, 12)[0] :]
    body = struct.pack("<I4s", len(part), b"JSON") + part + rest
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


GLB = Document(_glb_json, _with_glb_json)


def _header(data: bytes) -> Any:
    length = struct.unpack_from("<Q", data)[0]
    return json.loads(data[8 : 8 + length])


def _with_header(data: bytes, text: str) -> bytes:
    part = encoded(text)
    rest = data[8 + struct.unpack_from("<Q", data)[0] :]
    return struct.pack("<Q", len(part)) + part + rest


def _notes(data: bytes) -> Any:
    return json.loads(_header(data)["__metadata__"]["notes"])


def _with_notes(data: bytes, text: str) -> bytes:
    return _with_header(
        data, json.dumps({**_header(data), "__metadata__": {"notes": text}})
    )


SAFETENSORS = Document(_header, _with_header)
CHECKPOINT = Document(_notes, _with_notes)


def member_json(name: str) -> Document:
    """A document that is a member of a ZIP."""

    def get(data: bytes) -> Any:
        return json.loads(members(data)[name])

    def put(data: bytes, text: str) -> bytes:
        return zipped({**members(data), name: encoded(text)})

    return Document(get, put)


def members(data: bytes) -> dict[str, bytes]:
    """The members of a ZIP by their names."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(contents: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A ZIP of members."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return buffer.getvalue()


# Damage


RAW = "@raw@"
"""Stands before what is to be in the JSON as it is."""
_PLAIN = "[null,true,0,-1,1,3,0.5,1e300,-1e300,2147483648,4611686018427387904"
_PLAIN += ',"","x","\\u0000"'
_PLAIN += (
    ',"../../x","/etc/passwd","1","\\u001b[2J\\r\\n","a/b",".",[],{},[[]],[0],{"a":1}]'
)
VALUES: tuple[Any, ...] = (
    *json.loads(_PLAIN),
    *(f"{RAW}NaN", f"{RAW}-Infinity", f"{RAW}1e999", f"{RAW}{'9' * 10_000}"),
    *("[" * 5000, "[0, 0]"),
    *(f'{RAW}"\\ud800"', f'{RAW}"{"long" * 5000}"', f'{RAW}{{"a":1,"a":2}}'),
    *(
        f"{RAW}{1 << 64}",
        f"{RAW}{'[' * 70}{']' * 70}",
        f"{RAW}{'[' * 5000}{']' * 5000}",
    ),
)
WORDS = (
    b'NaN inf -1 0 1e999 -1e300 1e-320 99999999999999999999 [] {} "" \xff true ../../x'
).split()
WORDS += [b"\x1b[2J", b"\0", b"(" * 3000, b"w" * 5000]
_EVERYWHERE = (0, 0, 1, -1, 1e-300, 1e300, 1.7e308)
_WORD = re.compile(rb'-?\d[\d.eE+-]*|"[^"\n]*"|[A-Za-z_]+')
_RAW = re.compile(rf'"{RAW}((?:[^"\\]|\\.)*)"')
_NUMBERS: tuple[tuple[str, float], ...] = (
    *(
        ("<I", 0),
        ("<I", 0xFFFFFFFF),
        ("<I", 1 << 30),
        ("<Q", 1 << 40),
        ("<Q", (1 << 64) - 1),
    ),
    *(("<f", float("nan")), ("<f", float("-inf")), ("<f", 3e38), ("<d", float("nan"))),
)


def mutant(
    data: bytes,
    random: Random,
    document: Document | None = None,
    packing: Packing | None = None,
) -> bytes:
    """A damaged file.

    Args:
        data: The whole file.
        random: Decides on the damage.
        document: Where the file has JSON; None if it has none.
        packing: How its contents are packed; None if they are not.
    """
    if packing is not None and random.random() < 0.8:
        return packing.pack(mutant(packing.unpack(data), random, document))
    if document is not None and random.random() < 0.7:
        values = copy.deepcopy(document.get(data))
        for _ in range(random.choice((1, 1, 1, 2, 4))):
            values = _changed(values, random)
        return document.put(data, text_of(values))
    if data[:4] == b"PK\3\4" and random.random() < 0.6:
        return _repacked(data, random)
    if data[:2] == b"\x1f\x8b" and random.random() < 0.4:
        return _retarred(data, random)
    return random.choice(_CHANGES)(data, random)


def text_of(values: Any) -> str:
    """JSON of values, some of which are put into it as they are."""
    return _RAW.sub(lambda match: json.loads(f'"{match[1]}"'), json.dumps(values))


def _changed(values: Any, random: Random) -> Any:
    """The values with one of them taken out, doubled, moved, renamed or replaced."""
    slots = list(_slots(values))
    if not slots:
        return random.choice(VALUES)
    holder, key = random.choice(slots)
    match random.randrange(7):
        case 0:
            del holder[key]
        case 6:
            holder[key] = _with_one_number(holder[key], random.choice(_EVERYWHERE))
        case 1 if isinstance(holder, list):
            holder.insert(key, copy.deepcopy(holder[key]))
        case 2:
            other, slot = random.choice(slots)
            holder[key] = copy.deepcopy(other[slot])
        case 3 if isinstance(holder, dict):
            name = random.choice(("more", "", "../../x", "\x1b[2J", "x" * 3000))
            holder[name] = holder.pop(key)
        case _:
            holder[key] = copy.deepcopy(random.choice(VALUES))
    return values


def _with_one_number(values: Any, number: float) -> Any:
    """The values with one number in the place of all: a matrix of zeros, for
    instance.
    """
    if isinstance(values, dict):
        return {key: _with_one_number(value, number) for key, value in values.items()}
    if isinstance(values, list):
        return [_with_one_number(value, number) for value in values]
    if isinstance(values, int | float):
        return number
    return values


def _slots(values: Any) -> Iterator[tuple[Any, Any]]:
    """Every object or list with each of its keys; of long lists the first few."""
    keys: list[Any] = []
    if isinstance(values, dict):
        keys = list(values)
    elif isinstance(values, list):
        keys = list(range(min(len(values), 6)))
    for key in keys:
        yield values, key
        yield from _slots(values[key])


def _flipped(data: bytes, random: Random) -> bytes:
    flipped = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 8))):
        flipped[random.randrange(len(flipped))] ^= 1 << random.randrange(8)
    return bytes(flipped)


def _flipped_in_front(data: bytes, random: Random) -> bytes:
    """A flipped bit in the first bytes, where a file says how it is to be read."""
    front = min(len(data), 64)
    return _flipped(data[:front], random) + data[front:]


def _cut(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data))]


def _appended(data: bytes, random: Random) -> bytes:
    more = random.choice(
        (b"\0", b"\n", b"\xff" * 64, data[-64:], data, b"\0" * 100_000)
    )
    return data + more


def _spliced(data: bytes, random: Random) -> bytes:
    start = random.randrange(len(data))
    other = random.randrange(len(data))
    length = random.randrange(1, 64)
    return (
        data[:start]
        + data[other : other + length]
        + data[start + random.choice((0, length)) :]
    )


def _swapped(data: bytes, random: Random) -> bytes:
    """Two blocks of the same length, each in the place of the other."""
    length = random.choice((1, 4, 16, 256))
    first, second = sorted(random.randrange(len(data)) for _ in range(2))
    one = data[first : first + length]
    other = data[second : second + length]
    changed = bytearray(data)
    changed[second : second + length], changed[first : first + length] = one, other
    return bytes(changed)


def _numbered(data: bytes, random: Random) -> bytes:
    form, value = random.choice(_NUMBERS)
    part = struct.pack(form, value)
    front = random.random() < 0.5
    offset = random.randrange(min(len(data), 128) if front else len(data))
    return data[:offset] + part + data[offset + len(part) :]


def _reworded(data: bytes, random: Random) -> bytes:
    """A number, a name or a quoted text in the first bytes replaced."""
    words = list(_WORD.finditer(data[:20_000]))
    if not words:
        return _flipped(data, random)
    before = random.choice(words)
    word = random.choice(WORDS)
    if before[0].startswith(b'"') and random.random() < 0.7:
        word = b'"' + word.strip(b'"') + b'"'
    return data[: before.start()] + word + data[before.end() :]


_CHANGES: tuple[Change, ...] = (
    *(_flipped, _flipped, _flipped_in_front, _cut, _appended, _spliced, _swapped),
    *(_numbered, _numbered, _reworded, _reworded, _reworded),
)


# Archives


_BOMB = b"\0" * 50_000_000
_NAMES = (
    "../../x",
    "/tmp/x",
    "a/../../x",
    ".",
    "x" * 5000,
    "\x1b[2J",
    "C:\\x",
    "folder/",
)


def _repacked(data: bytes, random: Random) -> bytes:
    """A ZIP with a member renamed, doubled, dropped, damaged, or packed another way."""
    try:
        contents = members(data)
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError):
        return _flipped(data, random)
    name = random.choice(list(contents))
    match random.randrange(6):
        case 0:
            contents[random.choice(_NAMES)] = contents.pop(name)
        case 1:
            del contents[name]
        case 2:
            return zipped({**contents, name: _BOMB}, zipfile.ZIP_DEFLATED)
        case 3:
            return zipped(
                contents,
                random.choice(
                    (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
                ),
            )
        case 4:
            encrypted = bytearray(zipped(contents))
            for mark, offset in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
                encrypted[encrypted.index(mark) + offset] |= 1
            return bytes(encrypted)
        case _ if contents[name]:
            contents[name] = random.choice(_CHANGES)(contents[name], random)
    return zipped(contents)


def _retarred(data: bytes, random: Random) -> bytes:
    """A packed TAR whose first member leads elsewhere, is a link, or says that it is
    huge.
    """
    buffer = io.BytesIO()
    try:
        with (
            tarfile.open(fileobj=io.BytesIO(data)) as archive,
            tarfile.open(fileobj=buffer, mode="w:gz") as changed,
        ):
            for number, member in enumerate(archive.getmembers()):
                content = archive.extractfile(member)
                if number == 0:
                    member.name = random.choice((member.name, *_NAMES[:3]))
                    member.type = random.choice(
                        (
                            tarfile.REGTYPE,
                            tarfile.SYMTYPE,
                            tarfile.DIRTYPE,
                            tarfile.FIFOTYPE,
                        )
                    )
                    member.linkname = "../../x"
                changed.addfile(member, content)
    except (tarfile.TarError, EOFError, OSError):
        return _flipped(data, random)
    return buffer.getvalue()
