"""How the small detectors are trained: seeded, with AdamW along a cosine, and with an
average of the weights kept.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors.torch import save_file
from torch import Generator, Tensor, nn

from attacks.detectors.base import Detector
from attacks.detectors.weights import apply_weights, read_weights
from scenes.recipes.detector_augmentation import augment
from scenes.recipes.detector_pictures import LabelledPicture, made, training_sets
from scenes.recipes.evaluate_detectors import look_at, set_figures

Targets = list[dict[str, Tensor]]
"""For each image `boxes` (B, 4) in pixels and `labels` (B,), 1 + position in
SMALL_CLASSES.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """How a detector is trained.

    Attributes:
        pretraining: Steps of classifying cut-outs before the first epoch, of detectors
            that have this.
        epochs: Passes over the images.
        batch: Images a step.
        learning_rate: Highest one of AdamW, reached after the warm-up and then lowered
            along a cosine.
        warm_up: Fraction of the steps over which the learning rate rises.
        weight_decay: Of matrices.
        ema_decay: How much of the averaged weights (an exponential moving average) each
            step keeps.
        max_gradient_norm: Longer gradients are scaled down to it.
        low_resolution: Shorter image side in the first epochs, pixels.
        low_resolution_fraction: Fraction of the epochs at that size.
        final_fraction: Fraction of the epochs, the last ones, whose training examples
            are closer to those of use.
        validate_every: Epochs between two validations.
        seed: Seed of the weights, of the order and of every random change of the
            images.
    """

    pretraining: int = 1000
    epochs: int = 20
    batch: int = 8
    learning_rate: float = 1.2e-3
    warm_up: float = 0.06
    weight_decay: float = 0.02
    ema_decay: float = 0.998
    max_gradient_norm: float = 5.0
    low_resolution: int = 160
    low_resolution_fraction: float = 0.4
    final_fraction: float = 0.2
    validate_every: int = 2
    seed: int = 0


class Trainer(Protocol):
    """What the loop has to know of a detector."""

    def build(self) -> nn.Module:
        """The network with random weights, drawn from torch's generator."""
        ...

    def pretrain(
        self, model: nn.Module, pictures: Sequence[LabelledPicture], config: TrainConfig
    ) -> None:
        """Give the network a head start."""
        ...

    def begin_epoch(self, model: nn.Module, *, side: int | None, final: bool) -> None:
        """Make it ready for an epoch at a shorter image side, or at its usual one,
        which may be one of the last.
        """
        ...

    def losses(
        self,
        model: nn.Module,
        pictures: list[Tensor],
        targets: Targets,
        generator: Generator,
    ) -> dict[str, Tensor]:
        """What to minimise the sum of."""
        ...

    def detector(self, model: nn.Module) -> Detector:
        """The network in use, which keeps detections of any confidence."""
        ...


def train(
    trainer: Trainer,
    config: TrainConfig,
    pictures: Sequence[LabelledPicture],
    validation: Sequence[LabelledPicture],
    out: Path,
    *,
    start: Path | None = None,
) -> None:
    """Train, and write the weights of the best epoch and the curves into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(config.seed)
    model = trainer.build().to(memory_format=torch.channels_last)
    if start is not None:
        apply_weights(model, read_weights(start), start)
    elif config.pretraining:
        trainer.pretrain(model, pictures, config)
    averaged = {
        name: value.detach().clone() for name, value in model.state_dict().items()
    }
    matrices, vectors = (
        [p for p in model.parameters() if (p.ndim > 1) is many]
        for many in (True, False)
    )
    groups = [
        {"params": matrices, "weight_decay": config.weight_decay},
        {"params": vectors, "weight_decay": 0.0},
    ]
    optimiser = torch.optim.AdamW(groups, lr=config.learning_rate)
    history: list[dict[str, Any]] = []
    best = -math.inf
    for epoch in range(config.epochs):
        begun = time.monotonic()
        losses = _epoch(epoch, trainer, config, model, averaged, optimiser, pictures)
        record: dict[str, Any] = {
            "epoch": epoch + 1,
            "losses": losses,
            "seconds": time.monotonic() - begun,
        }
        if (epoch + 1) % config.validate_every == 0 or epoch + 1 == config.epochs:
            record |= validated(trainer, averaged, validation)
            merit = record["map"] - record["false_positives"]
            if merit >= best:
                best = merit
                notes = {"epoch": str(epoch + 1), "seed": str(config.seed)}
                save_file(shipped(averaged), out / "best.safetensors", metadata=notes)
        history.append(record)
        (out / "curves.json").write_text(
            json.dumps({"config": asdict(config), "history": history}, indent=1)
        )
        print(json.dumps(record))  # noqa: T201


def _epoch(
    epoch: int,
    trainer: Trainer,
    config: TrainConfig,
    model: nn.Module,
    averaged: dict[str, Tensor],
    optimiser: torch.optim.Optimizer,
    pictures: Sequence[LabelledPicture],
) -> dict[str, float]:
    """Train on every image once; the means of the losses."""
    torch.manual_seed(_seed(config.seed, epoch))
    model.train()
    coarse = epoch < round(config.low_resolution_fraction * config.epochs)
    final = epoch >= config.epochs - round(config.final_fraction * config.epochs)
    trainer.begin_epoch(
        model, side=config.low_resolution if coarse else None, final=final
    )
    steps = len(pictures) // config.batch
    total = dict[str, float]()
    for step, (images, targets) in enumerate(_batches(pictures, config, epoch)):
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * rate_factor(
                (epoch + step / steps) / config.epochs, config.warm_up
            )
        generator = Generator().manual_seed(_seed(config.seed, epoch, 7, step))
        with torch.autocast("cpu", torch.bfloat16):
            losses = trainer.losses(model, images, targets, generator)
        optimiser.zero_grad(set_to_none=True)
        torch.stack([value.float() for value in losses.values()]).sum().backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(model.parameters(), config.max_gradient_norm)
        optimiser.step()
        for name, value in model.state_dict().items():
            if value.is_floating_point():
                averaged[name].lerp_(value, 1 - config.ema_decay)
        for name, value in losses.items():
            total[name] = total.get(name, 0.0) + float(value.detach()) / steps
    return total


def _batches(
    pictures: Sequence[LabelledPicture], config: TrainConfig, epoch: int
) -> Iterator[tuple[list[Tensor], Targets]]:
    order = torch.randperm(len(pictures)).tolist()
    for start in range(0, len(pictures) - config.batch + 1, config.batch):
        images = []
        targets = []
        for i in order[start : start + config.batch]:
            image, boxes, labels = augment(
                pictures[i], Generator().manual_seed(_seed(config.seed, epoch, i))
            )
            images.append(image)
            targets.append({"boxes": boxes, "labels": labels})
        yield images, targets


def rate_factor(done: float, warm_up: float) -> float:
    """The learning rate after a fraction of all steps, as a fraction of the highest
    one.
    """
    if done < warm_up:
        return 0.02 + 0.98 * done / warm_up
    return 0.005 + 0.995 * 0.5 * (
        1 + math.cos(math.pi * (done - warm_up) / (1 - warm_up))
    )


def shipped(averaged: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights as they are shipped: float16, without BatchNorm's step counters."""
    return {
        name: value.half().contiguous()
        for name, value in averaged.items()
        if value.is_floating_point()
    }


def validated(
    trainer: Trainer, averaged: dict[str, Tensor], validation: Sequence[LabelledPicture]
) -> dict[str, object]:
    """The mAP of the averaged weights, and the false positives per image without
    objects.
    """
    with torch.random.fork_rng(devices=[]):
        model = trainer.build()
    model.load_state_dict(
        {name: value.float() for name, value in shipped(averaged).items()}, strict=False
    )
    seen = look_at(trainer.detector(model.eval()), validation)
    figures = set_figures(seen, 0.5)
    imagined = set_figures([view for view in seen if not view.objects], 0.5)[
        "false_positives"
    ]["per_picture"]
    measured = {name: figures.get(name, {}) for name in ("ap", "found")}
    return {
        "validation": measured,
        "map": figures.get("map", 0.0),
        "false_positives": imagined,
    }


def _seed(*parts: int) -> int:
    """One seed from several numbers, the same on every machine."""
    mixed = 0
    for part in parts:
        mixed = (mixed * 1_000_003 + part + 1) % (1 << 62)
    return mixed


def main(trainer: Trainer, defaults: TrainConfig, description: str | None) -> None:
    """Make the images that are missing, and train; every setting of the training is a
    flag.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--data", type=Path, default=Path("out/detector-data"))
    parser.add_argument("--out", type=Path, default=Path("out/detector"))
    parser.add_argument(
        "--start", type=Path, help="weights to begin from instead of pretraining"
    )
    parser.add_argument(
        "--processes", type=int, default=2, help="processes that make images"
    )
    parser.add_argument(
        "--scale", type=float, default=1.0, help="fraction of the scenes"
    )
    for field in fields(TrainConfig):
        default = getattr(defaults, field.name)
        parser.add_argument(
            f"--{field.name.replace('_', '-')}", type=type(default), default=default
        )
    options = vars(parser.parse_args())
    config = TrainConfig(
        **{field.name: options[field.name] for field in fields(TrainConfig)}
    )
    training, validation = training_sets(options["scale"])
    images = made(
        options["data"], [*training, *validation], processes=options["processes"]
    )
    pictures, scored = (
        [p for part in parts for p in part]
        for parts in (images[: len(training)], images[len(training) :])
    )
    train(trainer, config, pictures, scored, options["out"], start=options["start"])
