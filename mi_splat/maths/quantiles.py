"""Quantiles of any number of values, and what parts them into two groups."""

import math

import torch
from torch import Tensor

_BINS = 128


def quantile(values: Tensor, share: float) -> float:
    """The value below which so large a share of (M,) values lies; of any number of
    them.
    """
    return float(values.kthvalue(min(len(values), 1 + int(share * len(values)))).values)


def split_of(values: Tensor) -> float:
    """The number that best parts (M,) values >= 0 that are spread over decades into two
    groups (Otsu 1979, of fourth roots); infinity if there are none.
    """
    if not len(values):
        return math.inf
    roots = values**0.25
    top = float(roots.max())
    counts = torch.histc(roots, _BINS, 0.0, top).double()
    middles = (torch.arange(_BINS, dtype=torch.float64) + 0.5) * top / _BINS
    low = counts.cumsum(0)
    sums = (counts * middles).cumsum(0)
    high = counts.sum() - low
    gap = sums / low.clamp(min=1) - (sums[-1] - sums) / high.clamp(min=1)
    best = int((low * high * gap.square()).argmax())
    return float(((best + 1) * top / _BINS) ** 4)
