"""`fcos_small`: torchvision's FCOS, a one-stage detector without anchors, around the residual backbone of `small`.

Published ones use strides 8 to 128 and four convolutions of 256 channels in each branch of the head. Here the strides
are 8 to 64, as objects are large in 256-pixel pictures, and two convolutions of 96 channels do.
"""

from __future__ import annotations

from torchvision.models.detection import FCOS
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.fcos import FCOSHead

from attacks.detectors.classes import SMALL_CLASSES, SMALL_SIDE
from attacks.detectors.small import Backbone

_CONVOLUTIONS = 2
_SIZES = ((8,), (16,), (32,), (64,))
"""Pixels by level of the pyramid; the library gives objects of up to eight times this to a level."""


def build() -> FCOS:
    """The network with random weights, in training mode."""
    backbone, classes = Backbone(), len(SMALL_CLASSES) + 1
    anchors = AnchorGenerator(sizes=_SIZES, aspect_ratios=((1.0,),) * len(_SIZES))
    return FCOS(
        backbone,
        num_classes=classes,
        min_size=SMALL_SIDE,
        max_size=2 * SMALL_SIDE,
        anchor_generator=anchors,
        head=FCOSHead(backbone.out_channels, 1, classes, num_convs=_CONVOLUTIONS),
        score_thresh=0.05,
        topk_candidates=400,
    )
