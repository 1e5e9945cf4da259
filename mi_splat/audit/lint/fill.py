"""`fillRatio` as splat-transform of PlayCanvas defines it (its pull request 289): total footprint over cross-section.

The footprint of a Gaussian is the ellipse of one standard deviation over its two largest axes. The cross-section is the
mean of the three faces of the box between the 1st and the 99th percentile of the means along the axes of the file.
These come from a histogram of 1024 bins that doubles its range as values arrive, so they are approximate, and are made
here in the same way: far floaters widen the bins.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_splat.io.loaded import Arrays

BINS = 1024


def fill_ratio(arrays: Arrays) -> float:
    """Roughly the number of Gaussians on a ray through the splat.

    Args:
        arrays: N valid Gaussians in the order of the file; 0 of none.
    """
    scales = np.sort(arrays["scales"].astype(np.float64), axis=1)
    areas = np.pi * scales[:, 1] * scales[:, 2]
    if not len(areas):
        return 0.0
    columns = arrays["means"].astype(np.float64).T
    x, y, z = (max(0.0, binned_quantile(values, 0.99) - binned_quantile(values, 0.01)) for values in columns)
    section = (x * y + y * z + z * x) / 3
    if section == 0:  # a stack of Gaussians: how many there are
        section = binned_quantile(areas, 0.5)
    return float(areas.sum() / section)


def binned_quantile(values: NDArray[np.float64], share: float) -> float:
    """A quantile out of a histogram over the range that the order of the values leads to.

    Args:
        values: (N,) finite, at least one.
        share: Of the values that lie below, in (0, 1).
    """
    low, high = _range(values)
    if low == high:
        return low
    width = (high - low) / BINS
    bins = np.bincount(np.minimum(((values - low) / width).astype(np.int64), BINS - 1), minlength=BINS)
    used = np.flatnonzero(bins)
    reached = bins[used].cumsum()
    target = share * len(values)
    place = int(np.searchsorted(reached, target))
    if reached[place] == target and place + 1 < len(used):  # between two bins that hold something
        result = low + (used[place] + 1 + used[place + 1]) / 2 * width
    else:
        before = reached[place] - bins[used[place]]
        result = low + (used[place] + (target - before) / bins[used[place]]) * width
    return float(np.clip(result, values.min(), values.max()))


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    """Begun by the first two different values, and doubled towards each that lies outside."""
    different = np.flatnonzero(values != values[0])
    if not len(different):
        return float(values[0]), float(values[0])
    first, second = float(values[0]), float(values[different[0]])
    low, high = min(first, second), max(first, second)
    lowest, highest = np.minimum.accumulate(values), np.maximum.accumulate(values)
    records = np.flatnonzero((np.diff(lowest) < 0) | (np.diff(highest) > 0)) + 1
    for value in values[records]:
        while value < low:
            low -= high - low
        while value > high:
            high += high - low
    return low, high
