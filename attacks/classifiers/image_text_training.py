"""How `ImageText` is trained: `python -m attacks.classifiers.image_text_training --out FOLDER`.

Makes the pictures, trains, looks at pictures of objects, places and lights that were held out, and writes the weights,
a JSON file of figures and a card.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Generator, Tensor

from attacks.classifiers.catalogue import IMAGE_TEXT_WEIGHTS
from attacks.classifiers.image_text import PREPARATION, ImageText, ImageTextNetwork
from attacks.classifiers.image_text_captions import (
    CLASSES,
    TEMPLATES,
    WORDS,
    Caption,
    caption_text,
    draw_caption,
    only,
    tokens,
    true_of,
)
from attacks.classifiers.image_text_evaluation import card, figures
from attacks.classifiers.image_text_pictures import ToldPicture, many, told_pictures, told_splats
from attacks.detectors.training.augmentation import augment
from attacks.detectors.training.loop import export_weights
from attacks.detectors.training.pictures import LabelledPicture
from mi_splat.cli.flags import Unprefixed, parse
from mi_splat.errors import MiSplatError
from mi_splat.fields import Checked, Count, Seed, above, at_least
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.noted_tensors import NOTES

_LOOKS = 4
"""Pictures of each held-out scene."""
OnEpoch = Callable[[int, float], object]
"""Called with the number of finished epochs and the mean loss of the last one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageTextTraining(Checked):
    """The pictures, and how the network is trained on them.

    Attributes:
        scenes: Scenes of the training; one in eight shows no object.
        shots: Pictures of each scene.
        held_out: Scenes to look at after the training.
        splats: Of these, from the first on, so many are made into splats as well, four renders of each.
        epochs: Passes over the pictures.
        batch: Pictures a step.
        learning_rate: Highest one of AdamW, reached after a tenth of the steps, and then lowered along a cosine.
        weight_decay: Of AdamW.
        seed: Seed of the weights, of the order, of the captions and of the random changes of pictures.
    """

    scenes: Annotated[int, at_least(1)] = 640
    shots: Annotated[int, at_least(1)] = 6
    held_out: Annotated[int, at_least(1)] = 128
    splats: Count = 18
    epochs: Annotated[int, at_least(1)] = 40
    batch: Annotated[int, at_least(2, "pictures")] = 48
    learning_rate: Annotated[float, above(0)] = 2e-3
    weight_decay: Annotated[float, at_least(0)] = 0.05
    seed: Seed = 0


def contrastive_loss(texts: Tensor, images: Tensor, true: Tensor, temperature: Tensor) -> Tensor:
    """CLIP's symmetric InfoNCE, where a picture and every caption that is true of it belong together.

    With captions that are each true of one picture alone it is CLIP's; more than one partner share their probability
    evenly, as in UniCL (Yang et al., arXiv 2204.03610).
    """
    logits, weights = temperature * texts @ images.T, true.to(texts)
    by_text = F.cross_entropy(logits, weights / weights.sum(1, keepdim=True))
    return (by_text + F.cross_entropy(logits.T, (weights / weights.sum(0)).T)) / 2


def train(
    pictures: Sequence[ToldPicture], config: ImageTextTraining, *, on_epoch: OnEpoch | None = None
) -> ImageTextNetwork:
    """Train a network from random weights; the same arguments give the same bits on one machine with one thread."""
    torch.manual_seed(config.seed)
    network = ImageTextNetwork().to(memory_format=torch.channels_last).train()
    rng = np.random.default_rng(config.seed)
    batch = min(config.batch, len(pictures))
    steps = len(pictures) // batch
    decayed = [weights for weights in network.parameters() if weights.ndim > 1]
    others = [weights for weights in network.parameters() if weights.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": others, "weight_decay": 0.0}]
    optimiser = torch.optim.AdamW(groups, lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, config.learning_rate, total_steps=config.epochs * steps, pct_start=0.1, cycle_momentum=False
    )
    for epoch in range(config.epochs):
        total, order = 0.0, rng.permutation(len(pictures))
        for start in range(0, steps * batch, batch):
            chosen = [pictures[i] for i in order[start : start + batch]]
            shown = [name for name in CLASSES if any(name in picture.facts.objects for picture in chosen)]
            captions = [draw_caption(picture.facts, rng) for picture in chosen] + [only(name) for name in shown]
            changes = Generator().manual_seed(int(rng.integers(1 << 62)))
            features = network(torch.cat([_changed(picture, changes) for picture in chosen]))
            texts = network.encode_texts([_numbers(caption, rng) for caption in captions])
            true = true_of(captions, [picture.facts for picture in chosen])
            loss = contrastive_loss(texts, features, true, network.temperature)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
            total += float(loss.detach()) / steps
        if on_epoch is not None:
            on_epoch(epoch + 1, total)
    return network.eval()


def _changed(picture: ToldPicture, changes: Generator) -> Tensor:
    """(1, 3, S, S), prepared, of a picture with another frame, light, softness and noise."""
    nothing = torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64)
    image, _, _ = augment(LabelledPicture(picture.image, *nothing), changes)
    return PREPARATION(image.permute(1, 2, 0)[None])


def _numbers(caption: Caption, rng: np.random.Generator) -> list[int]:
    return tokens(caption_text(caption, TEMPLATES[int(rng.integers(len(TEMPLATES)))]))


def write(network: ImageTextNetwork, path: Path) -> None:
    """Write the weights as float16, with the words that they belong to."""
    export_weights(network.state_dict(), path, notes={NOTES: json.dumps({"words": WORDS})})


@dataclass(frozen=True, slots=True, kw_only=True)
class Options(Checked):
    """Options of the command.

    Attributes:
        out: Folder of the weights, the figures and the card.
        workers: Processes that make pictures.
        training: The pictures, and how the network is trained.
    """

    out: Path
    workers: Annotated[int, at_least(1)] = 2
    training: Unprefixed[ImageTextTraining] = ImageTextTraining()


def run(options: Options, show: Callable[[str], object]) -> None:
    """Make the pictures, train, look at what was held out, and write the three files."""
    config, workers = options.training, options.workers
    torch.set_num_threads(1)  # the same bits on any number of cores
    show(f"pictures of {config.scenes} scenes")
    made = many(told_pictures, "train", range(config.scenes), shots=config.shots, workers=workers)
    pictures = list(chain.from_iterable(made))
    network = train(pictures, config, on_epoch=lambda epoch, loss: show(f"epoch {epoch}: loss {loss:.3f}"))
    weights = options.out / IMAGE_TEXT_WEIGHTS.name
    write(network, weights)
    show(f"{config.held_out} held-out scenes, and splats of {config.splats}")
    held_out = many(told_pictures, "held-out", range(config.held_out), shots=_LOOKS, workers=workers)
    sets = {"path traced": list(chain.from_iterable(held_out))}
    if config.splats:
        splats = many(told_splats, "held-out", range(config.splats), shots=_LOOKS, workers=workers)
        sets["splat renders"] = list(chain.from_iterable(splats))
    record = {
        "fingerprint": ImageText(weights=weights).fingerprint,
        "training": asdict(config),
        "sets": {name: figures(weights, shown) for name, shown in sets.items()},
    }
    save_json(record, weights.with_suffix(".json"), indent=None)
    save_text(card(record), weights.with_suffix(".md"))


def main(words: Sequence[str]) -> int:
    """Run the command."""
    try:
        program = "python -m attacks.classifiers.image_text_training"
        run(parse(Options, words, program=program), lambda text: sys.stderr.write(f"{text}\n"))
    except MiSplatError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
