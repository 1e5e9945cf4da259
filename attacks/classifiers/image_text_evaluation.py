"""What `ImageText` answers about pictures of held-out objects, places and lights, and its card."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from attacks.classifiers.image_text import ImageText
from attacks.classifiers.image_text_captions import CLASSES, NOTHING, PAINTS, VIEWS, WORDS, Facts
from attacks.classifiers.image_text_pictures import ToldPicture
from attacks.rate import Rate
from attacks.tables import Table, sections
from mi_splat.assets import ASSETS

Question = tuple[str, Sequence[str], Callable[[Facts], tuple[str, ...]]]
"""What is asked, the classes to choose from, and which are true of a picture; where none is, it is not asked."""

_EMPTY_SURROUNDINGS = ("street", "park", "room", "car park", "sand", "earth", "snow", "concrete", "lawn", "paving")
QUESTIONS: tuple[Question, ...] = (
    ("assets", tuple(ASSETS), lambda facts: facts.objects),
    ("objects", CLASSES, lambda facts: facts.objects if facts.objects != NOTHING.objects else ()),
    ("vehicle or animal", ("vehicle", "animal"), lambda facts: facts.objects),
    ("paints", [f"{paint} {{}}" for paint in PAINTS], lambda facts: tuple(f"{paint} {{}}" for paint in facts.paints)),
    (
        "empty places",
        [f"empty {ground}" for ground in _EMPTY_SURROUNDINGS],
        lambda facts: (
            tuple(f"empty {ground}" for ground in facts.surroundings) if facts.objects == NOTHING.objects else ()
        ),
    ),
    (
        "views",
        [f"{{}} {view}" for view in VIEWS],
        lambda facts: tuple(f"{{}} {view}" for view in facts.views) if facts.objects != NOTHING.objects else (),
    ),
)
"""What the network is asked of held-out pictures; {} stands for the object."""


def answers(weights: Path, pictures: Sequence[ToldPicture], question: Question) -> list[tuple[str, str]]:
    """(object or place, best class) of each picture of which one of the classes is true; a right answer comes as ""."""
    _, classes, true_words = question
    named, victims = list[tuple[str, str]](), dict[str, ImageText]()
    for picture in pictures:
        true = set(true_words(picture.facts)) & set(classes)
        if not true:
            continue
        shown = picture.facts.objects[0]
        key = shown if "{}" in classes[0] else ""
        if key not in victims:
            victims[key] = ImageText([name.replace("{}", shown) for name in classes], weights=weights)
        with torch.no_grad():
            best = classes[int(victims[key].scores(picture.image[None].float() / 255).argmax())]
        name = shown if shown in CLASSES else picture.facts.surroundings[0]
        named.append((name, "" if best in true else best.replace("{}", "").strip()))
    return named


def figures(weights: Path, pictures: Sequence[ToldPicture]) -> dict[str, Any]:
    """By question: how many answers are right, by object as well, and what came instead."""
    result: dict[str, Any] = {}
    for question in QUESTIONS:
        named = answers(weights, pictures, question)
        lines = []
        for name in sorted({name for name, _ in named}):
            instead = Counter(answer for of, answer in named if of == name)
            right = Rate(successes=instead.pop("", 0), total=sum(of == name for of, _ in named))
            lines.append({"of": name, "right": right.as_dict(), "instead": dict(instead.most_common())})
        right = Rate(successes=sum(not answer for _, answer in named), total=len(named))
        result[question[0]] = {"classes": len(question[1]), "right": right.as_dict(), "by": lines}
    return result


def card(record: Mapping[str, Any]) -> str:
    """The card of the weights in Markdown, from what `image_text_training` writes as JSON."""
    sets, config = record["sets"], record["training"]
    names = [*sets]
    questions = [
        {"question": name, "classes": sets[names[0]][name]["classes"], **{of: sets[of][name]["right"] for of in names}}
        for name in sets[names[0]]
    ]
    objects = {of: {line["of"]: line for line in sets[of]["objects"]["by"]} for of in names}
    by_object = [
        {
            "object": name,
            **{of: objects[of].get(name, {}).get("right") for of in names},
            "instead": ", ".join(f"{word} {count}" for word, count in _instead(objects.values(), name).most_common()),
        }
        for name in CLASSES
    ]
    tables = [
        Table.of("Right answers", {key: key for key in questions[0]}, questions),
        Table.of("Objects", {key: key for key in by_object[0]}, by_object),
    ]
    top = Rate.of(sets[names[0]]["objects"]["right"])
    return _TEXT.format(
        top=top.words.replace("\u00a0", " "),
        classes=len(CLASSES),
        words=len(WORDS),
        tables=sections(tables),
        fingerprint=record["fingerprint"],
        **{key: config[key] for key in ("scenes", "shots", "epochs", "seed")},
    )


def _instead(lines: Any, name: str) -> Counter[str]:
    return sum((Counter(of.get(name, {}).get("instead", {})) for of in lines), Counter[str]())


_TEXT = """# image_text

A small network of images and texts, trained as CLIP is, on pictures of this project's own objects and places alone.
It is a victim for attacks on zero-shot classifiers that every computer can run. It knows this project's idea of a car,
not cars: conclude nothing from it about photographs.

**What the reader may conclude.** Of {classes} kinds of objects, it names {top} in path-traced pictures right. So it
is weak: look at what it says of clean pictures of your object before you call another answer an attack's success. The
objects, places, lights and cameras of these pictures were not in its training.

```python
from attacks.classifiers.image_text import ImageText

classifier = ImageText(["car", "bird", "empty road"])
scores = classifier.scores(images)  # (B, H, W, 3) sRGB in [0, 1] to (B, 3)
```

- The picture: the largest square in its middle, scaled to 64 pixels, goes through a residual network.
- The text: the mean of word vectors, and two layers. The order of words means nothing. There are {words} words
  (`attacks.classifiers.image_text_captions.WORDS`); another word is an error.
- The score of a class: the cosine between the picture and three texts about the class, times a temperature.

{tables}
"Assets" are the objects of `mi_splat.assets` alone, told apart from each other. Rows of "paints" and "views" choose
among words for the same object ("red car", "blue car"). An answer counts as right
if it is one of the words that are true of the picture. Brackets hold 95 % Wilson intervals. Four pictures show the same
object, so that true intervals are wider. Splats are Gaussians laid on the meshes, coloured from twelve pictures and
refined for 80 steps.

## Training
{scenes} scenes with {shots} path-traced pictures each, one scene in eight without an object; {epochs} passes, seed
{seed}. Asset seeds from 0 to 99,999 are those of the training, and from 500,000 to 599,999 those of the figures here.
Seeds from 900,000 on, which scenes and studies use, are in neither. The settings were chosen on objects of seeds from
300,000 to 399,999. The loss is CLIP's, with every caption that is true of a picture as its partner. No weights,
pictures or texts of others were used. To make the files again:

```text
python -m attacks.classifiers.image_text_training --out FOLDER
```

Fingerprint of the shipped weights with the default classes: `{fingerprint}`.
"""
