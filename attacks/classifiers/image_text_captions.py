"""What is true of a picture, captions that say part of it, and which captions are true of which pictures.

A caption states at most one word of each kind: "a photo of a red car on grass from above". A picture has all words that
are true of it, so that "vehicle" is true of a picture of a car.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from numpy.random import Generator
from torch import Tensor

from mi_splat.errors import InvalidValueError, nearest

OBJECTS: Mapping[str, tuple[str, ...]] = {
    "car": ("car", "vehicle"),
    "person": ("person", "human"),
    "stop sign": ("stop sign", "sign"),
    "elephant": ("elephant", "animal"),
    "bird": ("bird", "animal"),
    "tv": ("tv", "television"),
    "train": ("train", "vehicle"),
    "suitcase": ("suitcase", "bag"),
    "fire hydrant": ("fire hydrant", "hydrant"),
    "tree": ("tree", "plant"),
    "house": ("house", "building"),
    "street lamp": ("street lamp", "lamp"),
    "box": ("box",),
    "ball": ("ball", "sphere"),
    "cone": ("cone",),
    "cylinder": ("cylinder", "drum"),
}
"""Object that a picture can show to the words that are true of it, its name first."""

SURROUNDINGS: Mapping[str, tuple[str, ...]] = {
    "street": ("street", "road"),
    "park": ("park", "grass"),
    "room": ("room",),
    "asphalt": ("asphalt", "road"),
    "car park": ("car park", "asphalt"),
    "paving": ("paving", "pavement"),
    "sand": ("sand",),
    "earth": ("earth", "soil"),
    "snow": ("snow",),
    "concrete": ("concrete",),
    "grass": ("grass", "lawn"),
}
"""Place to the words that are true of it, its name first."""

PAINTS: Mapping[str, tuple[float, float, float]] = {
    "red": (0.68, 0.06, 0.06),
    "orange": (0.9, 0.42, 0.05),
    "yellow": (0.9, 0.78, 0.1),
    "green": (0.1, 0.45, 0.14),
    "blue": (0.08, 0.2, 0.62),
    "purple": (0.42, 0.12, 0.5),
    "brown": (0.36, 0.2, 0.1),
    "white": (0.9, 0.9, 0.88),
    "grey": (0.45, 0.46, 0.47),
    "black": (0.05, 0.05, 0.055),
}
"""Name of a paint to its sRGB colour."""

VIEWS = ("from above", "from the side")
LIGHTS = ("under a low sun", "under a high sun", "under a cloudy sky")

CLASSES = tuple(OBJECTS)
"""What is told apart where nothing else is asked for."""
TEMPLATES = ("a photo of {}", "a picture of {}", "{}")
"""How a class becomes texts, the mean of whose features stands for it."""

_EMPTY = "empty"
_INSIDE = ("street", "park", "room", "car park")
_STATED = 0.25
"""Chance that a caption says what it need not say."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What is true of a picture; each kind of words may be empty.

    Attributes:
        objects: Words for the object; ("empty",) where there is none.
        paints: Its paint.
        surroundings: Words for where it is.
        views: From where it is seen.
        lights: How it is lit.
    """

    objects: tuple[str, ...]
    paints: tuple[str, ...] = ()
    surroundings: tuple[str, ...] = ()
    views: tuple[str, ...] = ()
    lights: tuple[str, ...] = ()

    @property
    def kinds(self) -> tuple[tuple[str, ...], ...]:
        """The words, by kind."""
        return self.objects, self.paints, self.surroundings, self.views, self.lights


NOTHING = Facts(objects=(_EMPTY,))

Caption = tuple[str, str, str, str, str]
"""Object, paint, place, view and light; "" is not said."""


def draw_caption(facts: Facts, rng: Generator) -> Caption:
    """A caption that is true of a picture: its object, or that a place is empty, and by chance the rest."""
    chosen = []
    for kind, words in enumerate(facts.kinds):
        needed = kind == 0 or (kind == 2 and facts.objects == NOTHING.objects)
        say = bool(words) and (needed or rng.random() < _STATED)
        chosen.append(words[int(len(words) * rng.random() ** 2)] if say else "")  # the first more often than others
    return chosen[0], chosen[1], chosen[2], chosen[3], chosen[4]


def only(name: str) -> Caption:
    """The caption that names an object and says nothing else."""
    return name, "", "", "", ""


def caption_text(caption: Caption, template: str = TEMPLATES[0]) -> str:
    """A caption in words."""
    name, paint, surroundings, view, light = caption
    if name == _EMPTY:
        noun, where = f"{_EMPTY} {surroundings or 'place'}", ""
    else:
        noun, where = (
            f"{paint} {name}".strip(),
            f"{'in a' if surroundings in _INSIDE else 'on'} {surroundings}" if surroundings else "",
        )
    return " ".join(part for part in (template.format(with_article(noun)), where, view, light) if part)


def with_article(noun: str) -> str:
    """A noun with its article: "a car", "an elephant"."""
    return f"{'an' if noun[:1].lower() in 'aeio' else 'a'} {noun}"


def true_of(captions: Sequence[Caption], pictures: Sequence[Facts]) -> Tensor:
    """(C, P) bool, whether all that a caption says is true of a picture."""
    true = torch.ones(len(captions), len(pictures), dtype=torch.bool)
    for kind in range(5):
        words = sorted({word for facts in pictures for word in facts.kinds[kind]} | {c[kind] for c in captions} | {""})
        has = torch.tensor([[not word or word in facts.kinds[kind] for facts in pictures] for word in words])
        true &= has[[words.index(caption[kind]) for caption in captions]]
    return true


def _vocabulary() -> tuple[str, ...]:
    nouns = [noun for words in (*OBJECTS.values(), *SURROUNDINGS.values()) for noun in words]
    more = ["a an photo picture of in on place", _EMPTY, *PAINTS, *VIEWS, *LIGHTS]
    return tuple(sorted({word for text in (*nouns, *more) for word in text.split()}))


WORDS = _vocabulary()
"""The words that the texts are made of, in their order in the weights."""


def tokens(text: str, what: str = "text") -> list[int]:
    """Numbers of the words of a text; small and capital letters are the same, and commas and full stops nothing."""
    words = text.lower().replace(",", " ").replace(".", " ").split()
    if not words:
        raise InvalidValueError.of(what, "words", "none", f"say what it shows, for instance {CLASSES[0]}")
    for word in words:
        if word not in WORDS:
            do = nearest(word, WORDS, f"it knows {', '.join(CLASSES)} and more: image_text_captions.WORDS")
            raise InvalidValueError.of(what, "words that the network was trained on", repr(word), do)
    return [WORDS.index(word) for word in words]
