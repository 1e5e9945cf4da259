"""Which Gaussians are meant, as one value: the API and the flags of the command line. Light, so that --help is fast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mi_splat.errors import InvalidValueError
from mi_splat.fields import Box, Metavar, above, at_least, between, check, checked_number, several

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    MaskValue = (
        Path | str | Tensor | NDArray[np.bool_] | NDArray[np.integer[Any]] | Sequence[bool] | Sequence[int]
    )  # fmt: skip
    Click = str | tuple[int, int]
else:  # what the command line makes of words
    MaskValue, Click = Path | tuple, str


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """One object of a splat. Of several selectors together, what all of them select.

    Attributes:
        object: Part of a scene XML, by its id.
        box: Gaussians whose means lie in this box: x0 y0 z0 x1 y1 z1, world units.
        mask: File that says which: .npy (one bool a Gaussian, or row numbers), or a PLY with the positions of some. In
            Python also a tensor, an array or a list of these bools or row numbers; it is kept as a tuple.
        click: Pixels x,y of the first camera's picture; the object in front there, with all that is connected to it.
            Only what is near is looked at, by the measure of the picture, so click where the object is large. In Python
            also pairs of numbers; they are kept as text.
        cluster: Connected component by its size; 1 is the largest.
        link_distance: Two Gaussians are connected if each is within this multiple of the distance to the eighth
            neighbour of the other (click, cluster).
        link_colour: Largest difference in a channel of sRGB of connected Gaussians, in [0, 1]; None if colour does not
            count (click, cluster). Set it where two objects touch.
        planes: Objects stand on a floor, a desk or a street, which would connect them: so many of the largest planes
            are components of their own (click, cluster). More may help where too much is selected, and cut flat objects
            where they are too many.

    Raises:
        InvalidValueError: A value is out of its range.
    """

    object: str | None = None
    box: Box | None = None
    mask: MaskValue | None = None
    click: Annotated[tuple[Click, ...], Metavar("X,Y")] = ()
    cluster: Annotated[int, at_least(1, do="1 is the largest"), Metavar("RANK")] | None = None
    link_distance: Annotated[float, above(0, do="1.5 is usual"), Metavar("FACTOR")] = 1.5
    link_colour: Annotated[float, between(0, 1, do="0.1 is strict"), Metavar("DIFFERENCE")] | None = None
    planes: Annotated[int, between(0, 20, do="1 is usual")] = 1

    def __post_init__(self) -> None:
        self._take_values()
        check(self)
        if self.box is not None:
            low, high = self.box[:3], self.box[3:]
            if not all(a <= b for a, b in zip(low, high, strict=True)):  # not of nan either
                do = "give the lower corner first: x0 y0 z0 x1 y1 z1"
                raise InvalidValueError.of("box", "no first number above its second", self.box, do)
        _ = self.pixels

    def _take_values(self) -> None:
        """Make plain tuples of arrays, tensors and lists, so that selections can be compared and written as JSON."""
        if isinstance(self.mask, str):
            object.__setattr__(self, "mask", Path(self.mask))
        elif self.mask is not None and not isinstance(self.mask, Path):
            object.__setattr__(self, "mask", several(self.mask))
        clicks = several(self.click)
        if len(clicks) == 2 and all(isinstance(value, Real) for value in clicks):
            clicks = (clicks,)
        object.__setattr__(self, "click", tuple(map(_pixel_text, clicks)))

    @property
    def pixels(self) -> tuple[tuple[int, int], ...]:
        """The clicks as (x, y) in pixels, from the upper left."""
        pixels = []
        for text in map(str, self.click):
            x, _, y = text.partition(",")
            if not (x.strip().isdecimal() and y.strip().isdecimal()):
                raise InvalidValueError.of("click", "a pixel x,y", repr(text), "for instance 120,80")
            pixels.append((int(x), int(y)))
        return tuple(pixels)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is selected."""
        return not any(
            (self.object is not None, self.box is not None, self.mask is not None, self.click, self.cluster is not None)
        )

    def as_dict(self) -> dict[str, Any]:
        """What was selected by, as JSON can hold it; selectors that were not used are left out.

        Returns:
            The selectors by name.
        """
        values: dict[str, Any] = {}
        if self.object is not None:
            values["object"] = self.object
        if self.box is not None:
            values["box"] = list(self.box)
        if self.mask is not None:
            given = isinstance(self.mask, tuple)
            values["mask"] = {"gaussians": _count(self.mask)} if given else str(self.mask)
        if self.click or self.cluster is not None:
            values |= {"click": list(self.click)} if self.click else {}
            values |= {"cluster": self.cluster} if self.cluster is not None else {}
            values |= {"link_distance": self.link_distance, "link_colour": self.link_colour, "planes": self.planes}
        return values


def _pixel_text(click: Any) -> str:
    if isinstance(click, str):
        return click
    pair = several(click)
    if len(pair) != 2:
        raise InvalidValueError.of("click", "a pixel x,y", repr(click), "for instance (120, 80)")
    return ",".join(str(checked_number("click", number, whole=True)) for number in pair)


def _count(mask: Any) -> int:
    """How many Gaussians a mask that was given as a value names."""
    binary = len(mask) > 2 and set(mask) <= {0, 1}  # bools, or zeros and ones
    return sum(map(int, mask)) if binary or all(isinstance(entry, bool) for entry in mask) else len(set(mask))
