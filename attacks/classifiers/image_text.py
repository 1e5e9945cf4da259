"""`ImageText`: a small zero-shot classifier of images and texts, trained on the project's own pictures alone.

As CLIP (Radford et al., arXiv 2103.00020), it brings a picture and a text to unit vectors; the cosine between a picture
and "a photo of a car", times a temperature that was learnt, is the score of the class "car". So its classes are any
list of words that it knows. It has half a million weights, and knows this project's idea of a car, not cars.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from attacks.classifiers.catalogue import IMAGE_TEXT_WEIGHTS
from attacks.classifiers.frozen import FrozenClassifier, Preparation, ZeroShot, check_classes
from attacks.classifiers.image_text_captions import CLASSES, TEMPLATES, WORDS, tokens, with_article
from attacks.detectors.fasterrcnn_small import Block
from mi_splat.errors import InvalidValueError
from mi_splat.io.noted_tensors import check_like, read_noted_tensors
from mi_splat.io.parsing import DocumentReader

PREPARATION = Preparation(size=64, mean=(0.45, 0.45, 0.45), deviation=(0.25, 0.25, 0.25))
"""How pictures are brought to the network."""

_STEM, _STAGES, _FEATURES, _WIDTH = 32, (48, 96, 160), 128, 128
_HOTTEST = 100.0
"""Largest temperature, as in CLIP."""
_READER = DocumentReader(expected="weights of ImageText", do="restore the file, or train it again")


class ImageTextNetwork(nn.Module):
    """An encoder of pictures (a residual network) and one of texts (the mean of word vectors, and two layers).

    Since words are averaged, their order means nothing.
    """

    def __init__(self) -> None:
        super().__init__()
        widths = (_STEM, *_STAGES)
        self.stem = nn.Sequential(
            nn.Conv2d(3, _STEM, 3, 2, 1, bias=False), nn.BatchNorm2d(_STEM), nn.ReLU(inplace=True)
        )
        self.stages = nn.Sequential(*(Block(a, b, 2) for a, b in pairwise(widths)))
        self.image_head = nn.Linear(_STAGES[-1], _FEATURES)
        self.words = nn.EmbeddingBag(len(WORDS), _WIDTH, mode="mean")
        self.text_head = nn.Sequential(nn.Linear(_WIDTH, 2 * _WIDTH), nn.ReLU(), nn.Linear(2 * _WIDTH, _FEATURES))
        self.log_temperature = nn.Parameter(torch.tensor(1 / 0.07).log())

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, 3, S, S) prepared pictures to (B, F) unit vectors."""
        maps = self.stages(self.stem(pictures))
        return F.normalize(self.image_head(maps.mean((2, 3))), dim=1)

    def encode_texts(self, texts: Sequence[Sequence[int]]) -> Tensor:
        """Numbers of words of T texts to (T, F) unit vectors."""
        device = self.words.weight.device
        starts = torch.tensor([0, *map(len, texts[:-1])], device=device).cumsum(0)
        numbers = torch.tensor([number for text in texts for number in text], device=device)
        return F.normalize(self.text_head(self.words(numbers, starts)), dim=1)

    @property
    def temperature(self) -> Tensor:
        """What cosines are multiplied by to become scores."""
        return self.log_temperature.exp().clamp(max=_HOTTEST)


def load_network(weights: Path) -> ImageTextNetwork:
    """The network with weights from a file, frozen and in evaluation mode."""
    notes, tensors = read_noted_tensors(weights, _READER)
    words = notes.values.get("words")
    if words != list(WORDS):
        raise _READER.broken(f"weights {weights}, words", "others", f"the {len(WORDS)} of this version")
    with torch.random.fork_rng(devices=[]):
        network = ImageTextNetwork()
    wanted = {name: value.half() for name, value in network.state_dict().items() if value.is_floating_point()}
    check_like(tensors, wanted, f"weights {weights}", _READER)
    network.load_state_dict(tensors, strict=False)
    return network.eval().requires_grad_(False)


class ImageText(FrozenClassifier):
    """A zero-shot classifier over any list of classes in its vocabulary; a `Classifier`."""

    def __init__(
        self,
        classes: Sequence[str] = CLASSES,
        *,
        templates: Sequence[str] = TEMPLATES,
        weights: Path = IMAGE_TEXT_WEIGHTS,
        name: str = "image_text",
    ) -> None:
        """Load the weights, and encode the classes."""
        if isinstance(templates, str) or not templates or not all("{}" in template for template in templates):
            do = f"give a list such as {list(TEMPLATES)}"
            raise InvalidValueError.of("templates", "texts with {}", repr(templates)[:160], do)
        texts = [
            [tokens(template.replace("{}", with_article(noun)), f"class {noun!r}") for template in templates]
            for noun in check_classes(classes)
        ]
        network = load_network(Path(weights))
        directions = torch.stack([F.normalize(network.encode_texts(of).mean(0), dim=0) for of in texts])
        model = ZeroShot(network, directions, temperature=float(network.temperature))
        super().__init__(name, model, classes, PREPARATION)
