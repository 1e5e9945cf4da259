"""Differentiate with respect to the Gaussians.

`mi.traverse` shows the Gaussians of every splat as three arrays: `data` (centre, size,
rotation), `opacities` and `sh_coeffs` (colours). `mi.render` is differentiable in all
of them. Here Mitsuba's Adam recovers a target image in which red and blue are
exchanged. Left: the splat. Middle: after 15 steps. Right: the target.
"""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from PIL import Image

import mi_splat.render.plugins  # noqa: F401

mi.set_variant("llvm_ad_rgb")

scene = mi.load_dict(
    {
        "type": "scene",
        "integrator": {
            "type": "splat_tile",
            "background": {"type": "rgb", "value": [0.93, 0.93, 0.93]},
        },
        "car": {"type": "gaussians", "filename": "scenes/car_street_car.ply"},
        "sensor": {
            "type": "perspective",
            "fov": 36,
            "to_world": mi.ScalarTransform4f().look_at(
                origin=[7, 4.2, 2.4], target=[0, 0, 0.7], up=[0, 0, 1]
            ),
            "film": {"type": "hdrfilm", "width": 256, "height": 144},
        },
    }
)
params = mi.traverse(scene)
colours = "car.sh_coeffs"

clean = mi.render(scene)
target = mi.TensorXf(np.array(clean)[..., ::-1].copy())

adam = mi.ad.Adam(lr=0.05, params={colours: params[colours]})
for step in range(15):
    params.update(adam)
    loss = dr.mean(dr.square(mi.render(scene, params) - target), axis=None)
    dr.backward(loss)
    adam.step()
    print(f"step {step}: loss {loss.array[0]:.5f}")
params.update(adam)

row = np.concatenate([clean, mi.render(scene), target], axis=1)
Path("out").mkdir(exist_ok=True)
Image.fromarray((255 * row.clip(0, 1)).round().astype("uint8")).save(
    "out/02_differentiate.png"
)
