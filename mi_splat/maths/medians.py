"""Median colours of points towards some cameras, without others."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def medians_without(colours: Tensor, seen: Tensor, insides: Tensor) -> Tensor:
    """(C, P, 3) medians of (P, K, 3) colours, each without some of the cameras.

    Args:
        colours: Of P Gaussians towards K cameras.
        seen: (P, K) bool, the cameras that count.
        insides: (C, K) bool, the cameras that are left out each time. Where they leave
            fewer than two that count, all others do.

    Returns:
        The lower one of two where the number of colours is even.
    """
    found = _lower_medians(colours, seen, insides)
    left = seen.float() @ (~insides).float().T
    few = left.T < 2  # (C, P)
    rows = few.any(0).nonzero()[:, 0]
    if len(rows):
        everyone = torch.ones_like(seen[rows])
        of_all = _lower_medians(colours[rows], everyone, insides)
        found[:, rows] = torch.where(few[:, rows, None], of_all, found[:, rows])
    return found


def _lower_medians(colours: Tensor, seen: Tensor, insides: Tensor) -> Tensor:
    """The same without the exception; infinite where nothing is left.

    Colours are sorted once: without some of them, the one of rank m is the one of rank
    m + p of all, where p of those left out do not come after it.
    """
    most = seen.shape[1]
    hidden = ~seen[:, None]
    values, order = colours.mT.masked_fill(hidden, math.inf).sort(-1)
    ranks = torch.arange(most, dtype=torch.int16).expand(order.shape)
    places = torch.empty_like(order, dtype=torch.int16).scatter_(-1, order, ranks)
    # (K, P, 3) places of the cameras in that order; beyond all where they do not count
    places = places.masked_fill(hidden, most).permute(2, 0, 1).contiguous()
    left = seen.float() @ (~insides).float().T
    middles = ((left.T - 1) // 2).clamp(min=0).short()
    found = colours.new_empty(len(insides), len(colours), 3)
    for row, (inside, middle) in enumerate(zip(insides, middles, strict=True)):
        left_out = places[inside]
        passed = torch.zeros(1, dtype=torch.int16)
        for _ in left_out:
            at = (middle[:, None] + passed).clamp(max=most - 1)
            passed = (left_out <= at).sum(0, dtype=torch.int16)
        at = (middle[:, None] + passed).clamp(max=most - 1)
        found[row] = values.gather(-1, at.long()[..., None])[..., 0]
    return found
