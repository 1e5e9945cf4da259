"""Keeps the gradient of BatchNorm right where torch's own is wrong.

On the CPU (seen with torch 2.15), the backward pass of `BatchNorm2d` takes the values of the gradient in a wrong order
if the batch is one picture, the input is contiguous, and the gradient comes in the order of tokens, (B, H * W, C), as
from the attention of a transformer. There is no error; the gradient is another one.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn


def keep_gradients_right(model: nn.Module) -> None:
    """Bring the gradient into contiguous order before it enters any BatchNorm2d of `model`; the forward pass stays."""
    for part in model.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.register_forward_hook(_order_gradient)


def _order_gradient(module: nn.Module, inputs: Any, output: Tensor) -> None:
    if output.requires_grad:
        output.register_hook(Tensor.contiguous)  # type: ignore[no-untyped-call]
