"""Where a scene is looked at from, as one value that all commands share; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from mi_splat.cli.flags import Flag
from mi_splat.cli.values import Colour, Direction, Size
from mi_splat.fields import Called, Length, Range, between

Azimuth = Annotated[float, between(-360, 360, "degrees")]
Elevation = Annotated[float, between(-90, 90, "degrees", "90 is straight down")]
FieldOfView = Annotated[float, Range(low=0, high=180, open_low=True, open_high=True, unit="degrees", do="45 is usual")]
Point = Annotated[tuple[float, float, float], Range(unit="world units"), Called("X Y Z")]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraOptions:
    """Where a scene is looked at from.

    Without any of these flags it is the scene's own first camera, or an orbit camera that shows the object, or all if
    no object is meant.
    """

    cameras: Annotated[tuple[str, ...], Flag(aliases=("--camera", "--views")), Called("CAMERAS")] = ()
    """Any of: ids of the scene's own cameras, or all of them by `all`; hemisphere:N, orbit:N@ELEVATION,
    cap:N@MIN_ELEVATION or grid:AxE (azimuths x elevations) around --centre; a transforms .json; the .json of an earlier
    command (its cameras again); the cameras.json that 3DGS writes beside a splat; the folder of a set of pictures
    (COLMAP or transforms)."""
    azimuth: Azimuth | None = None
    """One camera on an orbit around --centre: degrees from +x towards +y; 30 if an orbit is used without it."""
    elevation: Elevation | None = None
    """Degrees above the ground, 90 is straight down; 20 if an orbit is used without it."""
    distance: Length | None = None
    """World units from the centre; None is as near as shows the object or the scene whole."""
    centre: Point | None = None
    """Point that cameras of an orbit or a set look at; None is the middle of the object, or of all Gaussians."""
    up: Direction = (0.0, 0.0, 1.0)
    """Direction that is up in the scene, for orbits and sets: an axis, or three numbers; scenes from COLMAP often have
    -y."""
    fov: FieldOfView = 45.0
    """Field of view of orbits and sets in degrees, over the shorter side of the picture."""
    size: Size | None = None
    """Pixels, as 256 or 256x192; None is the camera's own, 640x480 for orbits and sets."""
    near: Length | None = None
    """Gaussians nearer than this to the camera are not drawn, world units; None is what suits scene and cameras."""
    background: Colour | None = None
    """Colour behind the Gaussians, as white, #80b0e0 or three sRGB numbers in [0, 1]; None is the scene's own,
    black for a bare splat file."""

    @property
    def orbits(self) -> bool:
        """Whether one camera on an orbit is asked for."""
        return any(value is not None for value in (self.azimuth, self.elevation, self.distance, self.centre))
