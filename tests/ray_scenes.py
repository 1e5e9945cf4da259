"""Small scenes for `splat_ray` in which a pixel is one ray, so that its value can be
written down.
"""

from typing import Any

import numpy as np
import torch

from mi_splat.maths.sh import colour_to_dc
from mi_splat.render import variant
from mi_splat.scene import GaussianScene

variant.use()

import mitsuba as mi  # noqa: E402

from mi_splat.render.plugins.shape import shape_dict  # noqa: E402

T = mi.ScalarTransform4f
GREEN = (0.25, 0.5, 0.125)


def gaussian(
    mean: tuple[float, float, float],
    *,
    scale: float = 0.5,
    opacity: float = 0.6,
    colour: Any = GREEN,
) -> GaussianScene:
    """One round Gaussian."""
    return GaussianScene(
        torch.tensor([mean], dtype=torch.float32),
        torch.full((1, 3), scale),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([opacity]),
        colour_to_dc(torch.tensor([[colour]])),
    )


def linear(value: Any) -> Any:
    """Linear value of an sRGB one."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def looking(
    *, origin: Any = (0, 0, -5), target: Any = (0, 0, 0), size: int = 1
) -> dict[str, Any]:
    """A sensor with a narrow field, so that one pixel is one ray."""
    film = {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "pixel_format": "rgb",
        "rfilter": {"type": "box"},
    }
    up = [0, 1, 0]
    pose = T().look_at(origin=list(origin), target=list(target), up=up)
    return {
        "type": "perspective",
        "fov": 1e-3 if size == 1 else 40.0,
        "to_world": pose,
        "film": film,
    }


def scene_of(
    *splats: GaussianScene, integrator: dict[str, Any] | None = None, **parts: Any
) -> Any:
    shapes = {f"splat{n}": shape_dict(splat) for n, splat in enumerate(splats)}
    main = {"type": "splat_ray", **(integrator or {})}
    return mi.load_dict(
        {"type": "scene", "integrator": main, "sensor": looking(), **shapes, **parts}
    )


def pixel(loaded: Any, spp: int = 16) -> Any:
    return np.array(mi.render(loaded, spp=spp), dtype=np.float64)[0, 0]


def wall(z: float, **bsdf: Any) -> dict[str, Any]:
    """A large wall that faces the camera."""
    return {
        "type": "rectangle",
        "to_world": T().translate([0, 0, z]).rotate([0, 1, 0], 180).scale(50),
        "bsdf": bsdf or diffuse(0.5),
    }


def diffuse(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


def area(value: float) -> dict[str, Any]:
    return {"type": "area", "radiance": {"type": "rgb", "value": value}}


def constant(value: float) -> dict[str, Any]:
    return {"type": "constant", "radiance": {"type": "rgb", "value": value}}
