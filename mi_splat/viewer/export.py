"""A page in one file: pictures from all around, chosen by sliders; it needs no server and no network."""

from __future__ import annotations

import base64
import html
import io
import json
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import torch
from PIL import Image, ImageDraw

from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_text
from mi_splat.io.folders import check_new_file
from mi_splat.io.images import to_bytes
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.policy import script_hash

SHORTER_SIDE = 384
"""Pixels that the shorter side of an exported picture has at least; a whole multiple of the picture's own."""
JPEG_QUALITY = 82
MOST_PICTURES = 2000
"""Pictures of each splat in the largest page."""


def check_export(path: Path, views: tuple[int, int], *, force: bool) -> None:
    """Raise unless a page can be written.

    Args:
        path: The file.
        views: Number of azimuths and of elevations.
        force: Whether a file that is there may be replaced.

    Raises:
        InvalidValueError: The name has another ending than .html, the file is there, its folder is not, or there are
            too few or too many views.
    """
    if not (min(views) >= 1 and views[0] * views[1] <= MOST_PICTURES):
        expected = f"azimuths x elevations of 1 to {MOST_PICTURES} in all"
        raise InvalidValueError(message("views", expected, views, "for instance 24 4"))
    check_new_file(path, (".html", ".htm"), force=force)


def export_orbits(start: Orbit, views: tuple[int, int]) -> list[list[Orbit]]:
    """Rows of cameras around the point that a camera looks at, at its distance, from the lowest row to the highest.

    One row has the camera's own elevation. Several share the elevations from 0 to 90 degrees evenly, each in the middle
    of its part, as `mi_splat.camera_sets.grid` has it. The first azimuth is the camera's own.
    """
    azimuths, rows = views
    heights = [start.elevation] if rows == 1 else [90.0 * (row + 0.5) / rows for row in range(rows)]
    return [
        [replace(start, azimuth=start.azimuth + 360.0 * i / azimuths, elevation=height) for i in range(azimuths)]
        for height in heights
    ]


def write_export(
    painter: Painter,
    path: Path,
    *,
    views: tuple[int, int],
    force: bool = False,
    on_view: Callable[[], None] = lambda: None,
) -> None:
    """Write the page; the file appears whole or not at all.

    Args:
        painter: Makes the pictures, and has them inspected if it has an inspector.
        path: The file.
        views: Number of azimuths and of elevations.
        force: Whether a file that is there may be replaced.
        on_view: Called after each camera.

    Raises:
        InvalidValueError: As `check_export`.
        SplatFileError: The file cannot be written.
    """
    check_export(path, views, force=force)
    listed = list(_listed(painter, views, on_view))
    check_export(path, views, force=force)  # it took a while
    save_text(page_text(painter, listed, views), path)


def page_text(painter: Painter, listed: list[dict[str, Any]], views: tuple[int, int]) -> str:
    """The page as HTML.

    Args:
        painter: What made the pictures.
        listed: Each view, row by row.
        views: Number of azimuths and of elevations.
    """
    exhibit = painter.exhibit
    template = resources.files("mi_splat.viewer").joinpath("export.html").read_text("utf-8")
    (script,) = re.findall(r"<script>(.*?)</script>", template, re.DOTALL)
    pictures = [
        f'<figure><img id="picture{i}" src="{listed[0]["splats"][i]["picture"]}" alt="">'
        f'<figcaption><strong>{html.escape(name)}</strong> <span id="found{i}"></span></figcaption></figure>'
        for i, name in enumerate(exhibit.names)
    ]
    return Template(template).substitute(
        script=script_hash(script),
        title=html.escape(exhibit.title),
        figures="\n".join(pictures),
        last_column=views[0] - 1,
        last_row=views[1] - 1,
        hide_rows=" hidden" if views[1] == 1 else "",
        # No text can end the script element: "<" is written as JSON may write it.
        views=json.dumps(listed, allow_nan=False).replace("<", "\\u003c"),
        names=json.dumps(exhibit.names).replace("<", "\\u003c"),
    )


def _listed(painter: Painter, views: tuple[int, int], on_view: Callable[[], None]) -> Iterator[dict[str, Any]]:
    """Each view as the page holds it."""
    exhibit = painter.exhibit
    factor = max(1, math.ceil(SHORTER_SIDE / min(exhibit.size)))
    size = (factor * exhibit.size[0], factor * exhibit.size[1])
    for row in export_orbits(exhibit.start, views):
        for orbit in row:
            commands = painter.commands(orbit)
            yield {
                "azimuth": round(orbit.azimuth, 2),
                "elevation": round(orbit.elevation, 2),
                "place": list(exhibit.describe(orbit.camera(exhibit.size))),
                "splats": [_splat(painter, name, orbit, size, commands[name]) for name in exhibit.names],
            }
            on_view()


def _splat(painter: Painter, name: str, orbit: Orbit, size: tuple[int, int], command: str) -> dict[str, str]:
    """One splat in one view: the picture with what was found in it, that in words, and the command."""
    with torch.no_grad():
        pixels = to_bytes(painter.render(painter.exhibit.splat(name).scene, orbit.camera(size)))
    image, text = Image.fromarray(pixels), ""
    if painter.inspector is not None:
        inspection = painter.inspect(name, orbit)
        inspection.draw(ImageDraw.Draw(image), size[0] / painter.exhibit.size[0])
        text = inspection.text
    return {"picture": _data_uri(image), "found": text, "command": command}


def _data_uri(image: Image.Image) -> str:
    buffer = io.BytesIO()
    image.save(buffer, format="JPEG", quality=JPEG_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
