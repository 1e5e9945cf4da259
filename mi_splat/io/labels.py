"""Text in images: white on a filled plate."""

from collections.abc import Sequence

from PIL import ImageDraw, ImageFont

Plate = tuple[float, float, float, float]
"""Left, top, right and bottom of a label's plate, pixels."""


def plate_of(
    draw: ImageDraw.ImageDraw,
    corner: tuple[float, float],
    text: str,
    *,
    size: float = 16,
) -> Plate:
    """Where `write_label` puts its plate."""
    left, top, right, bottom = draw.textbbox(
        (0, 0), text, font=ImageFont.load_default(size=size)
    )
    width = right - left + size / 2
    height = bottom - top + 3 * size / 8
    x = min(max(corner[0], 0), max(draw.im.size[0] - width, 0))
    y = min(max(corner[1], 0), max(draw.im.size[1] - height, 0))
    return x, y, x + width, y + height


def free_plate(plates: Sequence[Plate], taken: Sequence[Plate]) -> Plate:
    """The first of some plates that covers nothing that is taken; else the one that
    covers least of it.
    """
    return min(plates, key=lambda plate: sum(_shared(plate, drawn) for drawn in taken))


def _shared(a: Plate, b: Plate) -> float:
    """Pixels that are in both."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return max(width, 0) * max(height, 0)


def write_label(
    draw: ImageDraw.ImageDraw,
    corner: tuple[float, float],
    text: str,
    colour: str,
    *,
    size: float = 16,
) -> None:
    """Write text on a filled plate, kept inside the image."""
    font = ImageFont.load_default(size=size)
    left, top, _, _ = draw.textbbox((0, 0), text, font=font)
    x, y, right, bottom = plate_of(draw, corner, text, size=size)
    draw.rectangle((x, y, right, bottom), fill=colour)
    draw.text(
        (x + size / 4 - left, y + 3 * size / 16 - top), text, fill="#ffffff", font=font
    )
