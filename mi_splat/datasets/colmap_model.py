"""What the files of a COLMAP model say, text and binary alike."""

from dataclasses import dataclass

from mi_splat.io.points import PointCloud

MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}
"""Number of parameters of each of COLMAP's camera models, in the order of its ids."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A camera of a model: picture size in pixels, name of the distortion model, its parameters."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Pose:
    """A picture of a model: quaternion (w, x, y, z) and translation from world to camera, camera id, file name."""

    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    lens: int
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """What the files of a model say, nothing checked but their form."""

    lenses: dict[int, Lens]
    poses: dict[int, Pose]
    points: PointCloud | None
