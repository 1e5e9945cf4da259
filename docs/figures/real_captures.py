"""Draws docs/images/real_captures.jpg:
`python docs/figures/real_captures.py RESULT [RESULT ...]`.

Each RESULT is a folder of `mi-splat dagger` from one camera. A row shows the clean
rendering, the attacked one, both with what the detector reports, and their difference
ten times as strong around grey.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

OUT = Path(__file__).resolve().parents[1] / "images" / "real_captures.jpg"
HEIGHT = 300
GAP = 8
GAIN = 10.0


def opened(path: Path) -> Image.Image:
    """An image, RGB."""
    return Image.open(path).convert("RGB")


def difference(result: Path) -> Image.Image:
    """How the attacked image differs from the clean one, `GAIN` times as strong."""
    clean = np.asarray(opened(result / "before.png"), np.float64)
    attacked = np.asarray(opened(result / "after.png"), np.float64)
    shown = 127.5 + GAIN * (attacked - clean)
    return Image.fromarray(shown.clip(0, 255).astype(np.uint8))


def row(result: Path) -> Image.Image:
    """Clean, attacked and difference, of one height."""
    pair = opened(result / "detections.png")
    parts = [pair, difference(result)]
    scaled = [
        part.resize((round(part.width * HEIGHT / part.height), HEIGHT), Image.LANCZOS)  # type: ignore[attr-defined]
        for part in parts
    ]
    width = sum(part.width for part in scaled) + GAP
    whole = Image.new("RGB", (width, HEIGHT), "white")
    whole.paste(scaled[0], (0, 0))
    whole.paste(scaled[1], (scaled[0].width + GAP, 0))
    return whole


def main() -> None:
    """Write the figure."""
    rows = [row(Path(word)) for word in sys.argv[1:]]
    width = max(one.width for one in rows)
    whole = Image.new("RGB", (width, len(rows) * (HEIGHT + GAP) - GAP), "white")
    for index, one in enumerate(rows):
        whole.paste(one, (0, index * (HEIGHT + GAP)))
    whole.save(OUT, quality=88)


if __name__ == "__main__":
    main()
