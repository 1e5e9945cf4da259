"""The rasteriser of the package gsplat as a `RenderFn`; it needs an NVIDIA GPU.

The project's tests give it a stand-in for the package. On a GPU gsplat 1.5.3 was built and refused the call of before
(see `packed`); with what stands here it was not run.
"""

import importlib
import importlib.util
from typing import Any

import torch
from torch import Tensor

from mi_splat.cameras import Camera
from mi_splat.errors import MiSplatError
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene, check_scene


class GsplatRenderer:
    """Renders splats with `gsplat.rasterization` in its classic mode; a `RenderFn`, differentiable.

    Args:
        settings: Background and near plane.

    Raises:
        MiSplatError: The package is not installed, or there is no GPU for it.
    """

    def __init__(self, settings: RenderSettings) -> None:
        self.settings = settings
        self.device = "cuda"
        if importlib.util.find_spec("gsplat") is None:
            do = "pip install gsplat, or leave it out of --methods"
            raise MiSplatError.of("method gsplat", "the package gsplat", "not installed", do)
        if not torch.cuda.is_available():
            do = "run it where there is one, or leave it out of --methods"
            raise MiSplatError.of("method gsplat", "an NVIDIA GPU that torch can use", "none", do)
        package: Any = importlib.import_module("gsplat")
        self._rasterization = package.rasterization

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """Render one picture; the scene may be anywhere, the picture comes back to where it is."""
        check_scene("scene", scene)
        options: Any = {"device": self.device, "dtype": torch.float32}
        means, scales, rotations, opacities, sh = (tensor.to(**options) for tensor in scene.tensors())
        intrinsics = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        pictures, _, _ = self._rasterization(
            means=means,
            quats=rotations,
            scales=scales,
            opacities=opacities,
            colors=sh,
            viewmats=torch.linalg.inv(camera.to_world)[None].to(**options),
            Ks=intrinsics[None].to(**options),
            width=camera.width,
            height=camera.height,
            near_plane=self.settings.near,
            sh_degree=round(sh.shape[1] ** 0.5) - 1,
            backgrounds=torch.tensor([self.settings.background], **options),
            rasterize_mode="classic",
            packed=False,  # gsplat 1.5 refuses a background in its packed mode, which is the default
        )
        picture: Tensor = pictures[0].to(scene.means.device)
        return picture
