"""What the files of a COLMAP model say, text and binary alike."""

from dataclasses import dataclass

from mi_splat.datasets.errors import DatasetError
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
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}
"""Number of parameters of each of COLMAP's camera models, in the order of its ids."""

ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE")
TWO_FOCALS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FISHEYE")
"""The camera models that are read, by how many focal lengths they have."""


def unreadable(where: str, model: str) -> DatasetError:
    """The error for a camera model that is not read."""
    do = "undistort the pictures with colmap image_undistorter, or cut panoramas into perspective images first"
    return DatasetError.of(where, f"a camera model of {', '.join((*ONE_FOCAL, *TWO_FOCALS))}", model, do)


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
