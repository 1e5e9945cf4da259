"""`fasterrcnn_small`: torchvision's Faster R-CNN around a residual backbone of our own,
small enough for a laptop CPU.

Most of the arithmetic of the usual Faster R-CNN is its stride-4 pyramid level, its 1000
proposals and its 1024-wide head. The objects here are large in 256-pixel images, so
the pyramid starts at stride 8, 150 proposals are kept, and the head is 256 wide.
"""

from collections import OrderedDict

import torch
from torch import Tensor, nn

from attacks.detectors.catalogue import SMALL_CLASSES, SMALL_SIDE
from attacks.detectors.vision import torchvision

detection = torchvision.models.detection
ops = torchvision.ops

_STEM = (24, 48)
_STAGES = ((96, 2), (160, 2), (256, 2))
_PYRAMID = 96
_HEAD = 256
_POOL = 5


class Block(nn.Module):
    """A residual block of two 3x3 convolutions; the first one carries the stride."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.norm2 = nn.BatchNorm2d(outputs)
        self.skip: nn.Module = nn.Identity()
        if stride != 1 or inputs != outputs:
            pool = nn.AvgPool2d(stride) if stride > 1 else nn.Identity()
            self.skip = nn.Sequential(
                pool, nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs)
            )
        nn.init.zeros_(self.norm2.weight)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) to (B, outputs, h / stride, w / stride)."""
        y = torch.relu(self.norm1(self.conv1(x)))
        return torch.relu(self.norm2(self.conv2(y)) + self.skip(x))


class Backbone(nn.Module):
    """Strided stem, three residual stages at strides 8, 16 and 32, and a feature
    pyramid over them.
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        inputs = 3
        for width in _STEM:
            layers += [
                nn.Conv2d(inputs, width, 3, 2, 1, bias=False),
                nn.BatchNorm2d(width),
                nn.ReLU(inplace=True),
            ]
            inputs = width
        self.stem = nn.Sequential(*layers)
        self.stages = nn.ModuleList()
        self.widths = tuple(width for width, _ in _STAGES)
        for width, count in _STAGES:
            blocks = [
                Block(inputs if i == 0 else width, width, 2 if i == 0 else 1)
                for i in range(count)
            ]
            self.stages.append(nn.Sequential(*blocks))
            inputs = width
        last = ops.feature_pyramid_network.LastLevelMaxPool()
        self.pyramid = ops.FeaturePyramidNetwork(list(self.widths), _PYRAMID, last)
        self.out_channels = _PYRAMID

    def forward(self, x: Tensor) -> OrderedDict[str, Tensor]:
        """(B, 3, H, W) to feature maps "0", "1", "2", "pool" at strides 8, 16, 32 and
        64.
        """
        x = self.stem(x)
        maps = OrderedDict()
        for i, stage in enumerate(self.stages):
            x = stage(x)
            maps[str(i)] = x
        result: OrderedDict[str, Tensor] = self.pyramid(maps)
        return result


class Head(nn.Module):
    """Two wide layers over a pooled box, as the library's TwoMLPHead, with normalised
    activations.

    Without the norms, the steps of Adam that suit the backbone push most of these units
    below zero for good.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Flatten(),
            nn.Linear(inputs, width),
            nn.LayerNorm(width),
            nn.ReLU(inplace=True),
            nn.Linear(width, width),
            nn.LayerNorm(width),
            nn.ReLU(inplace=True),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(R, channels, h, w) pooled features to (R, width)."""
        result: Tensor = self.layers(x)
        return result


def build() -> nn.Module:
    """The network with random weights, in training mode."""
    anchors = detection.anchor_utils.AnchorGenerator(
        sizes=((28,), (56,), (112,), (200,)), aspect_ratios=((0.4, 1.0, 2.2),) * 4
    )
    network: nn.Module = detection.FasterRCNN(
        Backbone(),
        min_size=SMALL_SIDE,
        max_size=2 * SMALL_SIDE,
        rpn_anchor_generator=anchors,
        rpn_pre_nms_top_n_train=400,
        rpn_pre_nms_top_n_test=400,
        rpn_post_nms_top_n_train=150,
        rpn_post_nms_top_n_test=150,
        rpn_batch_size_per_image=128,
        box_roi_pool=ops.MultiScaleRoIAlign(
            featmap_names=["0", "1", "2"], output_size=_POOL, sampling_ratio=2
        ),
        box_head=Head(_PYRAMID * _POOL**2, _HEAD),
        box_predictor=detection.faster_rcnn.FastRCNNPredictor(
            _HEAD, len(SMALL_CLASSES) + 1
        ),
    )
    return network
