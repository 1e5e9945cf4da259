"""Splat files: the only code that knows on-disk forms."""

from mi_splat.io.errors import SplatFileError, SplatFileWarning
from mi_splat.io.parameters import from_file_space, to_file_space
from mi_splat.io.ply import load_splat, save_splat

__all__ = [
    "SplatFileError",
    "SplatFileWarning",
    "from_file_space",
    "load_splat",
    "save_splat",
    "to_file_space",
]
