"""Text in pictures: white on a filled plate."""

from __future__ import annotations

from PIL import ImageDraw, ImageFont


def write_label(
    draw: ImageDraw.ImageDraw, corner: tuple[float, float], text: str, colour: str, *, size: float = 16
) -> None:
    """Write text on a filled plate, kept inside the picture.

    Args:
        draw: Of the picture.
        corner: Left and top of the plate, pixels.
        text: One line.
        colour: Of the plate, as CSS writes it.
        size: Of the font, pixels.
    """
    font = ImageFont.load_default(size=size)
    left, top, right, bottom = draw.textbbox((0, 0), text, font=font)
    width, height = right - left + size / 2, bottom - top + 3 * size / 8
    x = min(max(corner[0], 0), max(draw.im.size[0] - width, 0))
    y = min(max(corner[1], 0), max(draw.im.size[1] - height, 0))
    draw.rectangle((x, y, x + width, y + height), fill=colour)
    draw.text((x + size / 4 - left, y + 3 * size / 16 - top), text, fill="#ffffff", font=font)
