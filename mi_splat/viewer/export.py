"""A page in one file: pictures from the listed cameras and from all around; it needs no server and no network."""

import base64
import html
import io
import json
import math
import re
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from PIL import Image, ImageDraw

from mi_splat.errors import InvalidValueError, message, printable
from mi_splat.io.documents import save_text
from mi_splat.io.folders import check_new_file
from mi_splat.io.images import to_bytes
from mi_splat.viewer.exhibit import Exhibit
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.policy import script_hash

SHORTER_SIDE = 384
"""Pixels that the shorter side of an exported picture has at least; a whole multiple of the picture's own."""
LONGER_SIDE = 1000
"""Pixels of the longer side beyond which a picture is made smaller by a whole number."""
JPEG_QUALITY = 82
MOST_PICTURES = 2000
"""Pictures of each splat in the largest page."""
MOST_CAMERAS = 100
"""Listed cameras that have a picture in a page."""


def check_export(path: Path, views: tuple[int, int], *, force: bool) -> None:
    """Raise unless a page can be written."""
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
        [
            start.changed(azimuth=start.azimuth + 360.0 * i / azimuths, elevation=height, roll=0.0)
            for i in range(azimuths)
        ]
        for height in heights
    ]


def export_cameras(exhibit: Exhibit) -> dict[str, Orbit]:
    """The listed cameras that a page has pictures from, in their order: the first ones, since a list may be long.

    Beside photographs they are those from which there is one.
    """
    taken = None if exhibit.photographs is None else exhibit.photographs.numbers
    named = [(name, orbit) for name, orbit in exhibit.cameras.items() if taken is None or name in taken]
    return dict(named[:MOST_CAMERAS])


def write_export(
    painter: Painter,
    path: Path,
    *,
    views: tuple[int, int],
    force: bool = False,
    on_view: Callable[[], None] = lambda: None,
) -> None:
    """Write the page; the file appears whole or not at all."""
    check_export(path, views, force=force)
    exhibit = painter.exhibit
    cameras = [{"name": name, **_view(painter, orbit, on_view)} for name, orbit in export_cameras(exhibit).items()]
    rows = [] if exhibit.photographs else export_orbits(exhibit.start, views)
    around = [_view(painter, orbit, on_view) for row in rows for orbit in row]
    check_export(path, views, force=force)  # it took a while
    save_text(printable(page_text(painter, cameras, around, views)), path)


def page_text(
    painter: Painter, cameras: list[dict[str, Any]], around: list[dict[str, Any]], views: tuple[int, int]
) -> str:
    """The page as HTML."""
    exhibit = painter.exhibit
    template = resources.files("mi_splat.viewer").joinpath("export.html").read_text("utf-8")
    (script,) = re.findall(r"<script>(.*?)</script>", template, re.DOTALL)
    pictures = [
        f'<figure><img id="picture{i}" src="{(cameras or around)[0]["splats"][i]["picture"]}" alt="">'
        f'<figcaption><strong>{html.escape(name)}</strong> <span id="findings{i}"></span></figcaption></figure>'
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
        hide_around="" if around else " hidden",
        options="".join(f'<option value="{i}">{html.escape(view["name"])}</option>' for i, view in enumerate(cameras)),
        views=json.dumps(around, allow_nan=False).replace("<", "\\u003c"),
        cameras=json.dumps(cameras, allow_nan=False).replace("<", "\\u003c"),
        names=json.dumps(exhibit.names).replace("<", "\\u003c"),
    )


def _view(painter: Painter, orbit: Orbit, on_view: Callable[[], None]) -> dict[str, Any]:
    """A view as the page holds it."""
    exhibit, commands = painter.exhibit, painter.commands(orbit)
    seen = exhibit.size_at(orbit)
    factor = max(1, math.ceil(SHORTER_SIDE / min(seen)))
    shrunk = max(1, math.ceil(max(seen) / LONGER_SIDE))
    size = (factor * seen[0] // shrunk, factor * seen[1] // shrunk)
    facts = [*exhibit.describe(orbit.camera(seen)), painter.comparison(orbit)]
    view = {
        "azimuth": round(orbit.azimuth, 2),
        "elevation": round(orbit.elevation, 2),
        "facts": list(filter(None, facts)),
        "splats": [_splat(painter, name, orbit, size, commands.get(name, "")) for name in exhibit.names],
    }
    on_view()
    return view


def _splat(painter: Painter, name: str, orbit: Orbit, size: tuple[int, int], command: str) -> dict[str, str]:
    """One thing in one view: the picture with what was found in it, that in words, and the command."""
    image, text = Image.fromarray(to_bytes(painter.sized_picture(name, orbit, size))), ""
    if painter.inspector is not None:
        inspection = painter.inspect(name, orbit)
        inspection.draw(ImageDraw.Draw(image), size[0] / painter.exhibit.size_at(orbit)[0])
        text = inspection.text
    return {"picture": _data_uri(image), "findings": text, "command": command}


def _data_uri(image: Image.Image) -> str:
    buffer = io.BytesIO()
    image.save(buffer, format="JPEG", quality=JPEG_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
