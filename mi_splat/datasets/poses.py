"""The poses of a set alone: what of it can be used where its images or its lenses
cannot be read.
"""

from collections.abc import Sequence
from pathlib import Path

from mi_splat.cameras.camera import Camera
from mi_splat.datasets.colmap import find_model, read_model_cameras
from mi_splat.datasets.errors import DatasetError
from mi_splat.datasets.frames import Split
from mi_splat.datasets.transforms import find_transforms, read_cameras


def poses_of(
    path: Path, size: tuple[int, int], split: Split | None = None
) -> dict[str, Camera]:
    """The cameras of a set of images by name; the images need not be there.

    Args:
        path: The folder of a set, or a transforms file or camera path.
        size: Width and height of images where a file says none.
        split: The part of a COLMAP model; files have all of their cameras.

    Raises:
        DatasetError: There is no set, or its poses cannot be read.
    """
    transforms = find_transforms(path)
    if transforms is not None:
        return numbered(transforms.stem, read_cameras(transforms, size))
    model = find_model(path)
    if model is None:
        do = "pass the folder of a data set"
        raise DatasetError.of(
            str(path), "transforms.json or a COLMAP model in sparse/0", "neither", do
        )
    return {
        Path(name).stem: camera
        for name, camera in read_model_cameras(model, split).items()
    }


def numbered(kind: str, cameras: Sequence[Camera]) -> dict[str, Camera]:
    """Cameras by names that begin with their kind, and end with numbers of one
    length.
    """
    width = len(str(len(cameras) - 1))
    return {
        f"{kind}-{number:0{width}}": camera for number, camera in enumerate(cameras)
    }
