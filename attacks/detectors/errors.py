"""The error of everything that loads a detector."""

from __future__ import annotations

from mi_splat.errors import MiSplatError


class DetectorError(MiSplatError):
    """A detector that cannot be loaded or registered: unknown name, missing or unsuitable weights."""
