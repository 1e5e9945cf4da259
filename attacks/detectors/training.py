"""The training loop of `fasterrcnn_small`: seeded, resumable to the same bits, with an average of the weights kept."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torchvision.models.detection import FasterRCNN
from torchvision.models.detection._utils import BalancedPositiveNegativeSampler

from attacks.detectors import small
from attacks.detectors.augment import augment
from attacks.detectors.data import Sample
from attacks.detectors.pretraining import pretrain
from attacks.detectors.weights import DetectorError, apply_weights, read_weights
from mi_splat.errors import message

_EAGER, _SETTLED = (32, 0.5), (96, 0.25)  # boxes a picture, largest share of them with an object


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """How the detector is trained.

    Attributes:
        pretraining: Steps of naming cut-outs before the first epoch.
        epochs: Passes over the pictures.
        batch: Pictures a step.
        rate: Highest learning rate of AdamW, reached after the warm-up and then lowered along a cosine.
        warm_up: Share of the steps over which the rate rises.
        decay: AdamW's weight decay.
        average: How much of the averaged weights each step keeps.
        clip: Largest norm of the gradient.
        mixed: Convolutions and matrix products in bfloat16.
        coarse_side: Shorter image side in the first epochs, which are cheaper for it.
        coarse_share: Share of the epochs at that size.
        settle_share: Share of the epochs, the last ones, in which the box head learns from 96 boxes a picture, at most
            a quarter of them with an object, instead of 32 and a half: closer to what it meets in use, hence calmer.
        seed: Seed of the weights, of the order and of every random change of the pictures.
    """

    pretraining: int = 1000
    epochs: int = 20
    batch: int = 8
    rate: float = 1.2e-3
    warm_up: float = 0.06
    decay: float = 0.02
    average: float = 0.998
    clip: float = 5.0
    mixed: bool = True
    coarse_side: int = 160
    coarse_share: float = 0.4
    settle_share: float = 0.2
    seed: int = 0


OnStep = Callable[[int, int, dict[str, float]], None]
"""Called with (step in the epoch, steps of an epoch, losses)."""


class Training:
    """Network, averaged network, optimiser and position of one run.

    Attributes:
        model: The network being trained.
        averaged: State dict of the running average of its weights, as float32.
        epoch: Number of finished epochs.
        history: One dict of figures a finished epoch.
    """

    def __init__(self, config: TrainConfig) -> None:
        torch.manual_seed(config.seed)
        self.config = config
        self.model: FasterRCNN = small.build().to(memory_format=torch.channels_last)
        self.averaged = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        self.epoch = 0
        self.history: list[dict[str, object]] = []
        groups = [
            {"params": [p for p in self.model.parameters() if p.ndim > 1], "weight_decay": config.decay},
            {"params": [p for p in self.model.parameters() if p.ndim <= 1], "weight_decay": 0.0},
        ]
        self._optimiser = torch.optim.AdamW(groups, lr=config.rate)

    def pretrain(self, samples: Sequence[Sample], *, on_step: Callable[[int, int, float], None] | None = None) -> float:
        """Give the backbone its head start; returns the share of cut-outs that it names right."""
        config = self.config
        backbone = self.model.backbone
        right = pretrain(
            backbone, samples, steps=config.pretraining, seed=config.seed, mixed=config.mixed, on_step=on_step
        )
        self.averaged = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        self.history.append({"epoch": 0, "pictures": len(samples), "named": right})
        return right

    def begin_from(self, weights: Path) -> None:
        """Start from the weights of an earlier run.

        Raises:
            DetectorError: the file is missing or does not fit.
        """
        apply_weights(self.model, read_weights(weights), weights)
        self.averaged = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        digest = hashlib.sha256(weights.read_bytes()).hexdigest()
        self.history.append({"epoch": 0, "start": weights.name, "sha256": digest})

    def run_epoch(self, samples: Sequence[Sample], *, on_step: OnStep | None = None) -> dict[str, float]:
        """Train on every sample once; returns the mean of each loss."""
        config = self.config
        torch.manual_seed(_seed(config.seed, self.epoch))
        self.model.train()
        coarse = self.epoch < round(config.coarse_share * config.epochs)
        self.model.transform.min_size = (config.coarse_side if coarse else small.SIZE,)
        settled = self.epoch >= config.epochs - round(config.settle_share * config.epochs)
        self.model.roi_heads.fg_bg_sampler = BalancedPositiveNegativeSampler(*(_SETTLED if settled else _EAGER))
        steps = len(samples) // config.batch
        total: dict[str, float] = {}
        for step, (pictures, targets) in enumerate(self._batches(samples)):
            self._set_rate((self.epoch + step / steps) / config.epochs)
            losses = self._step(pictures, targets)
            for name, value in losses.items():
                total[name] = total.get(name, 0.0) + value / steps
            if on_step is not None:
                on_step(step + 1, steps, losses)
        self.epoch += 1
        return total

    def _batches(self, samples: Sequence[Sample]) -> Iterator[tuple[list[Tensor], list[dict[str, Tensor]]]]:
        order = torch.randperm(len(samples)).tolist()
        for start in range(0, len(samples) - self.config.batch + 1, self.config.batch):
            pictures, targets = [], []
            for i in order[start : start + self.config.batch]:
                generator = torch.Generator().manual_seed(_seed(self.config.seed, self.epoch, i))
                picture, boxes, labels = augment(samples[i], generator)
                pictures.append(picture)
                targets.append({"boxes": boxes, "labels": labels})
            yield pictures, targets

    def _step(self, pictures: list[Tensor], targets: list[dict[str, Tensor]]) -> dict[str, float]:
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.mixed):
            losses = self.model(pictures, targets)
        self._optimiser.zero_grad(set_to_none=True)
        total = torch.stack([v.float() for v in losses.values()]).sum()
        total.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip)
        self._optimiser.step()
        keep = self.config.average
        for name, value in self.model.state_dict().items():
            if value.is_floating_point():
                self.averaged[name].lerp_(value, 1 - keep)
        return {name: float(value.detach()) for name, value in losses.items()}

    def _set_rate(self, done: float) -> None:
        """The learning rate after a share `done` of all steps."""
        warm = self.config.warm_up
        if done < warm:
            factor = 0.02 + 0.98 * done / warm
        else:
            factor = 0.005 + 0.995 * 0.5 * (1 + math.cos(math.pi * (done - warm) / (1 - warm)))
        for group in self._optimiser.param_groups:
            group["lr"] = self.config.rate * factor

    def snapshot(self) -> FasterRCNN:
        """A network of the averaged weights, rounded to what is shipped."""
        model = small.build()
        model.load_state_dict({k: v.to(v.dtype) for k, v in rounded(self.averaged).items()}, strict=False)
        return model.eval()

    def save(self, folder: Path) -> None:
        """Write everything that the rest of the run depends on; the old checkpoint stays until the new one is whole."""
        folder.mkdir(parents=True, exist_ok=True)
        tensors = {f"model/{k}": v.contiguous() for k, v in self.model.state_dict().items()}
        tensors |= {f"average/{k}": v.contiguous() for k, v in self.averaged.items()}
        for number, state in self._optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser/{number}/{k}": v.contiguous() for k, v in state.items()}
        notes = {"config": asdict(self.config), "epoch": self.epoch, "history": self.history}
        temporary = folder / "checkpoint.partial"
        save_file(tensors, temporary, metadata={"notes": json.dumps(notes)})
        temporary.replace(folder / "checkpoint.safetensors")

    @classmethod
    def resume(cls, folder: Path, config: TrainConfig) -> Training:
        """Continue from the checkpoint in `folder`, or begin where there is none.

        Raises:
            DetectorError: the checkpoint belongs to a run with another configuration.
        """
        path = folder / "checkpoint.safetensors"
        training = cls(config)
        if not path.is_file():
            return training
        notes = json.loads(_metadata(path)["notes"])
        if notes["config"] != asdict(config):
            raise DetectorError(
                message(f"checkpoint {path}", asdict(config), notes["config"], "use the same one or another folder")
            )
        tensors = load_file(path)
        training.model.load_state_dict(_below(tensors, "model/"))
        training.averaged = _below(tensors, "average/")
        state = training._optimiser.state_dict()
        for key, value in _below(tensors, "optimiser/").items():
            number, name = key.split("/")
            state["state"].setdefault(int(number), {})[name] = value
        training._optimiser.load_state_dict(state)
        training.epoch, training.history = notes["epoch"], notes["history"]
        return training


def rounded(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights as they come back from a shipped file: float16, without BatchNorm's step counters."""
    return {k: v.half().float() for k, v in state.items() if v.is_floating_point()}


def ship(state: dict[str, Tensor], path: Path, *, notes: dict[str, str]) -> None:
    """Write float16 weights as safetensors."""
    tensors = {k: v.detach().half().contiguous() for k, v in state.items() if v.is_floating_point()}
    temporary = path.with_suffix(".partial")
    save_file(tensors, temporary, metadata=notes)
    temporary.replace(path)


def _seed(*parts: int) -> int:
    """One seed from several numbers, the same on every machine."""
    mixed = 0
    for part in parts:
        mixed = (mixed * 1_000_003 + part + 1) % (1 << 62)
    return mixed


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _metadata(path: Path) -> dict[str, str]:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        metadata: dict[str, str] = file.metadata()
    return metadata
