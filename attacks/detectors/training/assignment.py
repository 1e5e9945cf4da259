"""Which guess gets which object: the assignment of least total cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def least_cost(cost: NDArray[np.float64]) -> NDArray[np.int64]:
    """(R,) a column for each row, all different, so that the sum of their costs is least.

    Rows join one by one along the shortest augmenting path in reduced costs (Kuhn, "The Hungarian method for the
    assignment problem", 1955; Jonker and Volgenant, "A shortest augmenting path algorithm", 1987).

    Args:
        cost: (R, C) finite costs, with no more rows than columns.
    """
    rows, columns = cost.shape
    of_row, of_column = np.zeros(rows), np.zeros(columns)  # what is taken off each cost
    owner = np.full(columns, -1)
    for new in range(rows):
        shortest, before = np.full(columns, np.inf), np.full(columns, -1)
        reached = np.zeros(columns, bool)
        row, last = new, -1
        while row >= 0:
            lengths = cost[row] - of_row[row] - of_column
            better = ~reached & (lengths < shortest)
            shortest[better], before[better] = lengths[better], last
            last = int(np.where(reached, np.inf, shortest).argmin())
            step = shortest[last]
            of_row[new] += step
            of_row[owner[reached]] += step
            of_column[reached] -= step
            shortest[~reached] -= step
            reached[last] = True
            row = int(owner[last])
        while last >= 0:
            previous = int(before[last])
            owner[last] = new if previous < 0 else owner[previous]
            last = previous
    found = np.zeros(rows, np.int64)
    found[owner[owner >= 0]] = np.flatnonzero(owner >= 0)
    return found
