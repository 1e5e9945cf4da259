"""The type of what a search changes."""

from torch import Tensor

Parameters = dict[str, Tensor]
