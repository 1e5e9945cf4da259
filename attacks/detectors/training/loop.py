"""The training loop of the small detectors: seeded, resumable to the same bits, with an average of the weights kept."""

from __future__ import annotations

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Generator, Tensor, nn

from attacks.detectors.base import Detector
from attacks.detectors.catalogue import DetectorError
from attacks.detectors.training.augmentation import augment
from attacks.detectors.training.config import TrainConfig
from attacks.detectors.training.pictures import LabelledPicture
from attacks.detectors.weights import apply_weights, read_weights
from mi_splat.io.documents import save_bytes
from mi_splat.io.noted_tensors import NOTES, check_like, read_noted_tensors
from mi_splat.io.parsing import DocumentReader

OnStep = Callable[[int, int, dict[str, float]], None]
"""Called with (step in the epoch, steps of an epoch, losses)."""

Targets = list[dict[str, Tensor]]
"""For each picture `boxes` (B, 4) in pixels and `labels` (B,), 1 + position in SMALL_CLASSES."""


_READER = DocumentReader(
    expected="a checkpoint of this run", do="delete its folder, so that it begins anew", error=DetectorError
)


class DetectorTrainer(ABC):
    """What the loop has to know of a detector: its network, its losses, and how its epochs differ.

    Attributes:
        name: Of the detector.
    """

    name: str

    @abstractmethod
    def build(self) -> nn.Module:
        """The network with random weights, drawn from torch's generator."""

    @abstractmethod
    def begin_epoch(self, model: nn.Module, *, side: int | None, final: bool) -> None:
        """Make the network ready for an epoch.

        Args:
            model: The network.
            side: Shorter image side to train at, pixels; None is that of its use.
            final: Whether this is one of the last epochs, whose training examples are closer to what it meets in use.
        """

    @abstractmethod
    def losses(
        self, model: nn.Module, pictures: list[Tensor], targets: Targets, generator: Generator
    ) -> dict[str, Tensor]:
        """What to minimise the sum of, by name.

        Args:
            model: The network.
            pictures: (3, H, W) float32 each, in [0, 1].
            targets: Boxes (B, 4) in pixels and labels (B,) of each picture.
            generator: What is drawn.
        """

    def pretrain(
        self,
        model: nn.Module,
        samples: Sequence[LabelledPicture],
        config: TrainConfig,
        on_step: Callable[[int, int, float], None] | None,
    ) -> float | None:
        """Give the network a head start, in place.

        Args:
            model: The network.
            samples: Pictures with labels, from which objects are cut out.
            config: Steps, seed and precision.
            on_step: Told of each step: its number, how many there are, and the fraction that were right lately.

        Returns:
            Fraction of the cut-outs that it names right; None without a head start.
        """
        return None

    @abstractmethod
    def detector(self, model: nn.Module) -> Detector:
        """The network in use, keeping detections of any confidence."""


class Training:
    """Network, averaged network, optimiser and position of one run.

    Attributes:
        model: The network being trained.
        averaged: State dict of the running average of its weights, as float32.
        epoch: Number of finished epochs.
        history: One dict of figures a finished epoch.
    """

    def __init__(self, config: TrainConfig, trainer: DetectorTrainer) -> None:
        torch.manual_seed(config.seed)
        self.config, self.trainer = config, trainer
        self.model = trainer.build().to(memory_format=torch.channels_last)
        self.averaged = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        self.epoch = 0
        self.history: list[dict[str, object]] = []
        groups = [
            {"params": [p for p in self.model.parameters() if p.ndim > 1], "weight_decay": config.weight_decay},
            {"params": [p for p in self.model.parameters() if p.ndim <= 1], "weight_decay": 0.0},
        ]
        self._optimiser = torch.optim.AdamW(groups, lr=config.learning_rate)

    def pretrain(
        self, samples: Sequence[LabelledPicture], *, on_step: Callable[[int, int, float], None] | None = None
    ) -> float | None:
        """Give the network its head start."""
        right = self.trainer.pretrain(self.model, samples, self.config, on_step)
        self.averaged = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        self.history.append({"epoch": 0, "pictures": len(samples), "named": right})
        return right

    def begin_from(self, weights: Path) -> None:
        """Start from the weights of an earlier run."""
        apply_weights(self.model, read_weights(weights), weights)
        self.averaged = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        digest = hashlib.sha256(weights.read_bytes()).hexdigest()
        self.history.append({"epoch": 0, "start": weights.name, "sha256": digest})

    def run_epoch(self, samples: Sequence[LabelledPicture], *, on_step: OnStep | None = None) -> dict[str, float]:
        """Train on every sample once."""
        config = self.config
        torch.manual_seed(_seed(config.seed, self.epoch))
        self.model.train()
        low_resolution = self.epoch < round(config.low_resolution_fraction * config.epochs)
        final = self.epoch >= config.epochs - round(config.final_fraction * config.epochs)
        self.trainer.begin_epoch(self.model, side=config.low_resolution if low_resolution else None, final=final)
        steps = len(samples) // config.batch
        total: dict[str, float] = {}
        for step, (pictures, targets) in enumerate(self._batches(samples)):
            self._set_rate((self.epoch + step / steps) / config.epochs)
            generator = Generator().manual_seed(_seed(config.seed, self.epoch, 7, step))
            losses = self._step(pictures, targets, generator)
            for name, value in losses.items():
                total[name] = total.get(name, 0.0) + value / steps
            if on_step is not None:
                on_step(step + 1, steps, losses)
        self.epoch += 1
        return total

    def _batches(self, samples: Sequence[LabelledPicture]) -> Iterator[tuple[list[Tensor], Targets]]:
        order = torch.randperm(len(samples)).tolist()
        for start in range(0, len(samples) - self.config.batch + 1, self.config.batch):
            pictures, targets = [], []
            for i in order[start : start + self.config.batch]:
                generator = torch.Generator().manual_seed(_seed(self.config.seed, self.epoch, i))
                picture, boxes, labels = augment(samples[i], generator)
                pictures.append(picture)
                targets.append({"boxes": boxes, "labels": labels})
            yield pictures, targets

    def _step(self, pictures: list[Tensor], targets: Targets, generator: Generator) -> dict[str, float]:
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.mixed_precision):
            losses = self.trainer.losses(self.model, pictures, targets, generator)
        self._optimiser.zero_grad(set_to_none=True)
        total = torch.stack([v.float() for v in losses.values()]).sum()
        total.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.model.parameters(), self.config.max_gradient_norm)
        self._optimiser.step()
        keep = self.config.ema_decay
        for name, value in self.model.state_dict().items():
            if value.is_floating_point():
                self.averaged[name].lerp_(value, 1 - keep)
        return {name: float(value.detach()) for name, value in losses.items()}

    def _set_rate(self, done: float) -> None:
        """The learning rate after a fraction `done` of all steps."""
        warm = self.config.warm_up
        if done < warm:
            factor = 0.02 + 0.98 * done / warm
        else:
            factor = 0.005 + 0.995 * 0.5 * (1 + math.cos(math.pi * (done - warm) / (1 - warm)))
        for group in self._optimiser.param_groups:
            group["lr"] = self.config.learning_rate * factor

    def snapshot(self) -> Detector:
        """A detector of the averaged weights, rounded to what is shipped."""
        with torch.random.fork_rng(devices=[]):
            model = self.trainer.build()
        model.load_state_dict(rounded(self.averaged), strict=False)
        return self.trainer.detector(model.eval())

    def save(self, folder: Path) -> None:
        """Write everything that the rest of the run depends on; the old checkpoint stays until the new one is whole."""
        folder.mkdir(parents=True, exist_ok=True)
        tensors = {f"model/{k}": v.contiguous() for k, v in self.model.state_dict().items()}
        tensors |= {f"average/{k}": v.contiguous() for k, v in self.averaged.items()}
        for number, state in self._optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser/{number}/{k}": v.contiguous() for k, v in state.items()}
        notes = {"epoch": self.epoch, "history": self.history}
        save_bytes(save(tensors, metadata={NOTES: json.dumps(notes)}), folder / "checkpoint.safetensors")

    @classmethod
    def resume(cls, folder: Path, config: TrainConfig, trainer: DetectorTrainer) -> Training:
        """Continue from the checkpoint in `folder`, or begin where there is none."""
        path = folder / "checkpoint.safetensors"
        training = cls(config, trainer)
        if not path.is_file():
            return training
        notes, tensors = read_noted_tensors(path, _READER)
        training.epoch = notes.whole("epoch", 0, config.epochs)
        training.history = [dict(line.values) for line in notes.objects("history")]
        for line in notes.objects("history"):
            line.whole("epoch", 0, training.epoch)
        training._take(tensors, str(path))
        return training

    def _take(self, tensors: Mapping[str, Tensor], path: str) -> None:
        """The tensors of a checkpoint in the place of one's own."""
        model, self.averaged = _below(tensors, "model/"), _below(tensors, "average/")
        for what, tensors_of in (("model", model), ("average", self.averaged)):
            check_like(tensors_of, self.model.state_dict(), f"checkpoint {path}, {what}", _READER)
        self.model.load_state_dict(model)
        state = self._optimiser.state_dict()
        weights = [weight for group in self._optimiser.param_groups for weight in group["params"]]
        for number, weight in enumerate(weights):
            if moments := _below(tensors, f"optimiser/{number}/"):
                like = {"exp_avg": weight.detach(), "exp_avg_sq": weight.detach(), "step": torch.zeros(())}
                check_like(moments, like, f"checkpoint {path}, optimiser {number}", _READER)
                state["state"][number] = moments
        self._optimiser.load_state_dict(state)


def rounded(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights as they come back from a shipped file: float16, without BatchNorm's step counters."""
    return {k: v.half().float() for k, v in state.items() if v.is_floating_point()}


def export_weights(state: dict[str, Tensor], path: Path, *, notes: dict[str, str]) -> None:
    """Write float16 weights as safetensors."""
    tensors = {k: v.detach().half().contiguous() for k, v in state.items() if v.is_floating_point()}
    save_bytes(save(tensors, metadata=notes), path)


def _seed(*parts: int) -> int:
    """One seed from several numbers, the same on every machine."""
    mixed = 0
    for part in parts:
        mixed = (mixed * 1_000_003 + part + 1) % (1 << 62)
    return mixed


def _below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
