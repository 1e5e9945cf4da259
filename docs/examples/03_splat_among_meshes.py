"""A splat among meshes.

The integrator `splat_ray` traces paths through splats and surfaces. The car below is a
splat; the ground and the mirror behind it are surfaces. The splat casts a shadow on the
ground and is reflected in the mirror, although no light falls on the splat itself. The
image is linear, so `mi.util.write_bitmap` converts it to sRGB.
"""

from pathlib import Path

import mitsuba as mi

import mi_splat.render.plugins  # noqa: F401

mi.set_variant("llvm_ad_rgb")
T = mi.ScalarTransform4f


def grey(value: float) -> dict[str, object]:
    """A diffuse surface."""
    return {
        "type": "diffuse",
        "reflectance": {"type": "rgb", "value": [value] * 3},
    }


scene = mi.load_dict(
    {
        "type": "scene",
        "integrator": {"type": "splat_ray", "max_depth": 4},
        "car": {"type": "gaussians", "filename": "scenes/car_street_car.ply"},
        "ground": {"type": "rectangle", "to_world": T().scale(500), "bsdf": grey(0.3)},
        "mirror": {
            "type": "rectangle",
            "to_world": T()
            .translate([0.6, 2.2, 1.3])
            .rotate([1, 0, 0], 90)
            .scale([3, 1.3, 1]),
            "bsdf": {"type": "conductor"},
        },
        "sky": {
            "type": "sunsky",
            "sun_direction": [1.0, 0.2, 0.9],
            "sun_scale": 3.0,
            "sky_scale": 3.0,
        },
        "sensor": {
            "type": "perspective",
            "fov": 42,
            "to_world": T().look_at([5.5, -7.5, 3.2], [0.4, -0.4, 0.7], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 240, "height": 150},
        },
    }
)
Path("out").mkdir(exist_ok=True)
mi.util.write_bitmap(
    "out/03_splat_among_meshes.png", mi.render(scene, spp=12), write_async=False
)
