"""Which Gaussians are meant, as one value: the API and the flags of the command line.

Light, so that --help is fast.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from mi_splat.errors import InvalidValueError
from mi_splat.fields import Box, Metavar, above, at_least, between, check


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """One object of a splat. Of several selectors together, what all of them select.

    Attributes:
        object: Part of a scene XML, by its id.
        box: Gaussians whose means lie in this box: x0 y0 z0 x1 y1 z1, world units.
        mask: Mask file: .npy (one bool per Gaussian, or row numbers), or a PLY with the
            positions of the selected Gaussians.
        click: Pixels x,y in the first camera's image; selects the object in front there
            and all Gaussians connected to it. Only Gaussians near the click, relative
            to the image size, are searched, so click where the object is large. With
            --detect, --boxes or --masks it chooses among what these select.
        cluster: Connected component by rank of size; 1 is the largest.
        detect: Classes of --detectors: the object in their boxes, in the photographs of
            --cameras SET or in renderings from other --cameras. In each image it is the
            most confident box of any of these classes. The object is cut out of the
            boxes, and the images vote.
        boxes: JSON file with boxes around the object in two images or more, as
            `mi-splat view` writes it; cut out as with --detect.
        masks: Folder of masks of two images or more, nonzero where the object is, each
            with the name of its image in --cameras SET and the ending .png. The images
            vote for the Gaussians that make up the masks.
        link_distance: Two Gaussians are connected if each is within this multiple of
            the other's distance to its eighth neighbour (click, cluster).
        link_colour: Largest difference in any sRGB channel between connected Gaussians
            (click, cluster). Set it where two objects touch. Default: colour is
            ignored.
        planes: Number of dominant planes (floor, desk, street) to separate first,
            because they would connect the objects on them (click, cluster). Increase it
            if too much is selected; too many planes cut flat objects.

    Raises:
        InvalidValueError: A value is out of its range.
    """

    object: str | None = None
    box: Box | None = None
    mask: Path | None = None
    click: Annotated[tuple[str, ...], Metavar("X,Y")] = ()
    cluster: (
        Annotated[int, at_least(1, do="1 is the largest"), Metavar("RANK")] | None
    ) = None
    link_distance: Annotated[float, above(0, do="1.5 is usual"), Metavar("FACTOR")] = (
        1.5
    )
    link_colour: (
        Annotated[float, between(0, 1, do="0.1 is strict"), Metavar("DIFFERENCE")]
        | None
    ) = None
    planes: Annotated[int, between(0, 20, do="1 is usual")] = 1
    detect: Annotated[tuple[str, ...], Metavar("CLASS")] = ()
    boxes: Path | None = None
    masks: Annotated[Path | None, Metavar("FOLDER")] = None

    def __post_init__(self) -> None:
        check(self)
        if self.box is not None:
            low = self.box[:3]
            high = self.box[3:]
            # not of nan either
            if not all(a <= b for a, b in zip(low, high, strict=True)):
                do = "give the lower corner first: x0 y0 z0 x1 y1 z1"
                raise InvalidValueError.of(
                    "box", "no first number above its second", self.box, do
                )
        _ = self.pixels

    @property
    def pixels(self) -> tuple[tuple[int, int], ...]:
        """The clicks as (x, y) in pixels, from the upper left."""
        pixels = []
        for text in self.click:
            x, _, y = text.partition(",")
            if not (x.strip().isdecimal() and y.strip().isdecimal()):
                raise InvalidValueError.of(
                    "click", "a pixel x,y", repr(text), "for instance 120,80"
                )
            pixels.append((int(x), int(y)))
        return tuple(pixels)

    @property
    def needs_images(self) -> bool:
        """Whether images say where the object is, from several cameras."""
        return bool(self.detect) or self.boxes is not None or self.masks is not None

    @property
    def is_empty(self) -> bool:
        """Whether nothing is selected."""
        return not self.as_dict()

    def as_dict(self) -> dict[str, Any]:
        """What was selected by, as JSON can hold it; selectors that were not used are
        left out.

        Returns:
            The selectors by name.
        """
        selectors = {
            "object": self.object,
            "box": None if self.box is None else list(self.box),
            "mask": None if self.mask is None else str(self.mask),
            "click": list(self.click) or None,
            "cluster": self.cluster,
            "detect": list(self.detect) or None,
            "boxes": None if self.boxes is None else str(self.boxes),
            "masks": None if self.masks is None else str(self.masks),
        }
        used: dict[str, Any] = {
            name: value for name, value in selectors.items() if value is not None
        }
        if used.keys() & {"click", "cluster"}:
            used |= {
                "link_distance": self.link_distance,
                "link_colour": self.link_colour,
                "planes": self.planes,
            }
        return used
