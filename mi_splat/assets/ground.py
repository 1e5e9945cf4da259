"""A square of ground to stand on."""

from typing import Literal

from mi_splat.assets.mesh import Asset
from mi_splat.assets.primitives import sheet
from mi_splat.assets.textures import grass, road

Kind = Literal["road", "grass", "asphalt"]


def square_of_ground(
    kind: Kind, *, side: float, tile: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Asset:
    """A flat square with a texture."""
    (x, y, z), half, repeat = centre, side / 2, side / tile
    corners = [[[x - half, y - half, z], [x + half, y - half, z]], [[x - half, y + half, z], [x + half, y + half, z]]]
    if kind == "asphalt":
        texture, repeat = road(round(256 * repeat), 0, markings=False), 1.0
    else:
        texture = road(256, 0, markings=False) if kind == "road" else grass(256, 0)
    return Asset("ground", (sheet(corners, texture, repeat=(repeat, repeat), smooth=False),))
