"""Quantiles of any number of values."""

from torch import Tensor


def quantile(values: Tensor, share: float) -> float:
    """The value below which so large a share of (M,) values lies; of any number of
    them.
    """
    return float(values.kthvalue(min(len(values), 1 + int(share * len(values)))).values)
