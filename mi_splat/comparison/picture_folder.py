"""Pictures that another program has made from the same cameras, in the place of a renderer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from mi_splat.cameras import Camera
from mi_splat.datasets.errors import DatasetError
from mi_splat.datasets.pictures import picture_size, read_picture
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import file_name
from mi_splat.io.pictures import PICTURES
from mi_splat.scene import GaussianScene


class PictureFolder:
    """A folder with a picture for each camera, called as `mi-splat render` calls its own; reads them as a `RenderFn`.

    Args:
        folder: Where they are: NAME.png or NAME.jpg for the camera NAME.
        cameras: All cameras that will be asked for, by name.
        background: sRGB colour behind transparent pixels.

    Raises:
        InvalidValueError: There is no such folder.
        DatasetError: A picture is missing, cannot be read, or has another size than its camera.
    """

    def __init__(
        self, folder: Path, cameras: Mapping[str, Camera], *, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        if not folder.is_dir():
            raise InvalidValueError.of(str(folder), "a folder of pictures", "none", "check the path")
        self.background = background
        self._cameras = dict(cameras)
        self._paths = {name: _path(folder, name) for name in cameras}
        for name, camera in cameras.items():
            picture_size(self._paths[name], (camera.width, camera.height))

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """The picture of a camera.

        Args:
            scene: Not looked at.
            camera: One of those that were given.

        Returns:
            (H, W, 3) float32 in [0, 1].

        Raises:
            InvalidValueError: It is another camera.
            DatasetError: The picture cannot be read any more.
        """
        name = next((name for name, known in self._cameras.items() if known is camera), None)
        if name is None:
            do = "pass a camera that the folder was opened with"
            raise InvalidValueError.of("camera", f"one of {', '.join(self._cameras)}", "another", do)
        return read_picture(self._paths[name], downscale=1, background=self.background)[0].to(scene.means.device)


def _path(folder: Path, name: str) -> Path:
    """The picture of a camera."""
    stem = file_name(name)
    path = next((folder / f"{stem}{ending}" for ending in PICTURES if (folder / f"{stem}{ending}").is_file()), None)
    if path is None:
        held = sorted(entry.name for entry in folder.iterdir())[:3]
        got = f"none among {', '.join(held)}, ..." if held else "an empty folder"
        do = "call pictures as their cameras, as `mi-splat render --out FOLDER` does"
        raise DatasetError.of(str(folder), f"{stem}.png for the camera {name}", got, do)
    return path
