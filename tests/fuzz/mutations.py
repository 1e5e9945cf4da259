"""Damages files: bytes, words, and the structure of JSON inside of them; the same for the same random numbers."""

import copy
import json
import re
import struct
from random import Random
from typing import Any

from tests.fuzz.documents import Document

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
