"""How a set is prepared; light, for the command line."""

from dataclasses import dataclass
from typing import Annotated

from mi_splat.errors import MiSplatError
from mi_splat.fields import Metavar, between, check

VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
"""Endings of videos."""


class PreparationError(MiSplatError):
    """No set can be made of what was given; the message says why, and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PrepareConfig:
    """How a set is prepared.

    Attributes:
        longest_side: Longest side in pixels; larger images are downscaled.
        interval: Seconds of video per frame; the sharpest frame of each interval is
            kept.
        max_images: Maximum number of images: a folder with more is refused, and for a
            video the interval is increased.
        features: Maximum number of feature points per image; twice as many take four
            times as long to match.

    Raises:
        FieldError: A number is out of range.
    """

    longest_side: Annotated[int, between(128, 8192, "pixels", "1600 is usual")] = 1600
    interval: Annotated[
        float, between(0.1, 600, "seconds", "1 is usual"), Metavar("SECONDS")
    ] = 1.0
    max_images: Annotated[int, between(3, 1000, "images", "300 is usual")] = 300
    features: Annotated[int, between(256, 32768, "points", "4096 is usual")] = 4096

    def __post_init__(self) -> None:
        check(self)
