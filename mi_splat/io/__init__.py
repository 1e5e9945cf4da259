"""Splat files: the only code that knows on-disk forms."""

from mi_splat.io.errors import SplatFileError, SplatFileWarning, SplatLossWarning
from mi_splat.io.parameters import from_raw_parameters, to_raw_parameters
from mi_splat.io.splat_files import load_splat, save_splat

__all__ = [
    "SplatFileError",
    "SplatFileWarning",
    "SplatLossWarning",
    "from_raw_parameters",
    "load_splat",
    "save_splat",
    "to_raw_parameters",
]
