"""Splat files: the only code that knows on-disk forms.

Importing this package is light: torch comes with scenes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
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

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "mi_splat.io.errors": (
            "SplatFileError",
            "SplatFileWarning",
            "SplatLossWarning",
        ),
        "mi_splat.io.parameters": ("from_raw_parameters", "to_raw_parameters"),
        "mi_splat.io.splat_files": ("load_splat", "save_splat"),
    },
)
