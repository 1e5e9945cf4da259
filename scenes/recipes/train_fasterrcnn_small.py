"""Trains `fasterrcnn_small`: `python -m scenes.recipes.train_fasterrcnn_small --out
out/detector`.

Before the first epoch the backbone learns to classify objects that are cut out of the
training images. A step of detector training sees some ten objects and spends most of
its time on where they are; here a step sees 64 for the same price, so that features
that tell the classes apart come much sooner.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Generator, Tensor, nn
from torchvision.models.detection import FasterRCNN
from torchvision.models.detection._utils import BalancedPositiveNegativeSampler
from torchvision.ops import roi_align

from attacks.detectors import fasterrcnn_small
from attacks.detectors.base import Detector
from attacks.detectors.catalogue import BACKGROUND, SMALL_CLASSES, SMALL_SIDE
from attacks.detectors.torchvision import RCNNDetector
from scenes.recipes.detector_pictures import LabelledPicture
from scenes.recipes.detector_training import Targets, TrainConfig, main

_USUAL_SAMPLER = (32, 0.5)
_FINAL_SAMPLER = (96, 0.25)
"""Boxes an image that the box head learns from, and the largest fraction of them with
an object.
"""
_SIDE = 96
"""Pixels of the side of a cut-out."""
_BATCH = 64
_RATE = 2e-3
"""Cut-outs a step, and the highest learning rate."""
_BACKGROUND_FRACTION = 1 / 9
_MARGIN = (0.95, 1.5)


class FasterRCNNTrainer:
    """In the last epochs the box head learns from more boxes, fewer of them with an
    object.
    """

    def build(self) -> nn.Module:
        """The network with random weights."""
        model: nn.Module = fasterrcnn_small.build()
        return model

    def begin_epoch(self, model: nn.Module, *, side: int | None, final: bool) -> None:
        """Set the image side and the sampler of boxes."""
        assert isinstance(model, FasterRCNN)
        model.transform.min_size = (side or SMALL_SIDE,)
        model.roi_heads.fg_bg_sampler = BalancedPositiveNegativeSampler(
            *(_FINAL_SAMPLER if final else _USUAL_SAMPLER)
        )

    def losses(
        self,
        model: nn.Module,
        pictures: list[Tensor],
        targets: Targets,
        generator: Generator,
    ) -> dict[str, Tensor]:
        """The library's own."""
        losses: dict[str, Tensor] = model(pictures, targets)
        return losses

    def pretrain(
        self, model: nn.Module, pictures: Sequence[LabelledPicture], config: TrainConfig
    ) -> None:
        """Stem and stages classify cut-outs; the learning rate rises and falls once."""
        backbone = model.backbone
        steps = config.pretraining
        assert isinstance(backbone, fasterrcnn_small.Backbone)
        torch.manual_seed(config.seed)
        generator = Generator().manual_seed(config.seed)
        classifier = nn.Linear(sum(backbone.widths), len(SMALL_CLASSES) + 1)
        parameters = [
            *backbone.stem.parameters(),
            *backbone.stages.parameters(),
            *classifier.parameters(),
        ]
        optimiser = torch.optim.AdamW(parameters, lr=_RATE, weight_decay=0.05)
        backbone.train()
        for step in range(steps):
            done = step / steps
            if done < 0.1:
                factor = done / 0.1
            else:
                factor = 0.5 * (1 + math.cos(math.pi * (done - 0.1) / 0.9))
            optimiser.param_groups[0]["lr"] = _RATE * max(factor, 0.01)
            images, names = cut_outs(pictures, _BATCH, generator)
            with torch.autocast("cpu", torch.bfloat16):
                x = backbone.stem(images.contiguous(memory_format=torch.channels_last))
                pooled = []
                for stage in backbone.stages:
                    x = stage(x)
                    pooled.append(x.mean((2, 3)))
                scores = classifier(torch.cat(pooled, 1))
            loss = F.cross_entropy(scores.float(), names, label_smoothing=0.1)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(parameters, 5.0)
            optimiser.step()

    def detector(self, model: nn.Module) -> Detector:
        """The network behind the `Detector` interface."""
        assert isinstance(model, FasterRCNN)
        return RCNNDetector("fasterrcnn_small", model, (BACKGROUND, *SMALL_CLASSES))


def cut_outs(
    samples: Sequence[LabelledPicture], count: int, generator: Generator
) -> tuple[Tensor, Tensor]:
    """(count, 3, 96, 96) squares of images, most around an object, and (count,)
    labels, 0 for none.
    """
    pictures = []
    regions = []
    names = []
    for i in torch.randint(len(samples), (count,), generator=generator).tolist():
        sample = samples[i]
        number = int(torch.randint(max(len(sample.labels), 1), (), generator=generator))
        a, b, c = torch.rand(3, generator=generator).tolist()
        if (
            len(sample.labels) == 0
            or float(torch.rand((), generator=generator)) < _BACKGROUND_FRACTION
        ):
            box, name = _anywhere(sample, a, b, c)
        else:
            box = _around(sample.boxes[number], a, b, c)
            name = int(sample.labels[number])
        pictures.append(sample.image)
        regions.append(box)
        names.append(name)
    whole = torch.stack(pictures).permute(0, 3, 1, 2).float() / 255
    cut = roi_align(
        whole, [r[None] for r in regions], _SIDE, sampling_ratio=2, aligned=True
    )
    mirrored = torch.rand((count, 1, 1, 1), generator=generator) < 0.5
    cut = torch.where(mirrored, cut.flip(3), cut)
    gain = 0.65 + 0.7 * torch.rand((count, 1, 1, 1), generator=generator)
    tint = 0.88 + 0.24 * torch.rand((count, 3, 1, 1), generator=generator)
    noise = (
        0.05
        * torch.rand((count, 1, 1, 1), generator=generator)
        * torch.randn(cut.shape, generator=generator)
    )
    return ((cut * gain * tint + noise).clamp(0, 1) - 0.45) / 0.225, torch.tensor(names)


def _around(box: Tensor, a: float, b: float, c: float) -> Tensor:
    """A square of 0.95 to 1.5 times the longer side of `box`, a little off its
    centre.
    """
    size = (box[2:] - box[:2]).max()
    side = size * (_MARGIN[0] + (_MARGIN[1] - _MARGIN[0]) * a)
    centre = (box[:2] + box[2:]) / 2 + size * 0.2 * (box.new_tensor([b, c]) - 0.5)
    return torch.cat([centre - side / 2, centre + side / 2])


def _anywhere(
    sample: LabelledPicture, a: float, b: float, c: float
) -> tuple[Tensor, int]:
    """A square anywhere that holds little of any object, with name 0; an object's own
    square if it holds much.
    """
    size = sample.image.shape[0]
    side = size * (0.15 + 0.3 * a)
    corner = torch.tensor([b, c]) * (size - side)
    box = torch.cat([corner, corner + side])
    for taken, label in zip(sample.boxes, sample.labels.tolist(), strict=True):
        shared = (
            (torch.minimum(box[2:], taken[2:]) - torch.maximum(box[:2], taken[:2]))
            .clamp(min=0)
            .prod()
        )
        if float(shared) > 0.1 * float(
            torch.minimum((taken[2:] - taken[:2]).prod(), torch.tensor(side * side))
        ):
            return _around(taken, a, b, c), int(label)
    return box, 0


if __name__ == "__main__":
    main(FasterRCNNTrainer(), TrainConfig(), __doc__)
