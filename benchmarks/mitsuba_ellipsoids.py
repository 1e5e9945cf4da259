"""Does Mitsuba's `ellipsoids` shape meet the rays that it should, and does its image
depend on the unit of length?

    python benchmarks/mitsuba_ellipsoids.py [--count 100] [--image FILE] [--json]

The benchmark's splat and camera, with all lengths times 0.1 to 1,000: geometry that is
the same in another unit. First one Gaussian at a time: a grid of rays around it, and
whether the shape of three standard deviations is met, beside the discriminant of the
same quadratic equation in float64. Then images: `volprim_rf_basic` and `splat_ray` in
each unit, as PSNR to the image of `splat_ray` in the first. `--image` draws the
rays around the Gaussian with most errors.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from render import shell
from stages import camera_of

from mi_splat.cameras.camera import Camera
from mi_splat.maths.metrics import psnr
from mi_splat.maths.rotation import to_matrix
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.volprim import Volprim
from mi_splat.scene import GaussianScene

UNITS = (0.1, 1.0, 10.0, 100.0, 1000.0)
SIZE = (256, 256)
"""Width and height of the images."""
SIDE = 33
"""Rays along one side of the grid around a Gaussian."""
SAME = 999.0
"""In dB, for equal images."""
EXTENT = 3.0
"""Standard deviations at which the shape ends."""


def in_unit(
    scene: GaussianScene, camera: Camera, unit: float
) -> tuple[GaussianScene, Camera]:
    """The same with all lengths times `unit`."""
    pose = camera.to_world.clone()
    pose[:3, 3] *= unit
    seen = Camera(to_world=pose, lens=camera.lens)
    return scene.replace(means=scene.means * unit, scales=scene.scales * unit), seen


def hits(
    splat: GaussianScene, origin: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which rays of a grid around a Gaussian meet its shape, and which of them Mitsuba
    says do: (SIDE, SIDE) each.
    """
    import mitsuba as mi

    from mi_splat.render.plugins.shape import ellipsoid_arrays

    mean = splat.means[0].double().numpy()
    scale = EXTENT * splat.scales[0].double().numpy()
    ahead = (mean - origin) / np.linalg.norm(mean - origin)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    steps = np.linspace(-1.1, 1.1, SIDE) * scale.max()
    x, y = np.meshgrid(steps, steps)
    towards = (mean + x[..., None] * right + y[..., None] * down - origin).reshape(
        -1, 3
    )
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    to_unit_sphere = (to_matrix(splat.rotations)[0].double().numpy() / scale).T
    start = to_unit_sphere @ (origin - mean)
    step = towards @ to_unit_sphere.T
    along = step @ start
    length = np.square(step).sum(1)
    expected = along**2 - length * (np.square(start).sum() - 1) > 0
    loaded = mi.load_dict(
        {"type": "scene", "splat": {"type": "ellipsoids", **ellipsoid_arrays(splat)}}
    )
    directions = mi.Vector3f(
        *(mi.Float(towards[:, axis].astype(np.float32)) for axis in range(3))
    )
    valid = (
        loaded.ray_intersect(mi.Ray3f(mi.Point3f(*origin.tolist()), directions))
        .is_valid()
        .numpy()
    )
    return expected.reshape(SIDE, SIDE), valid.reshape(SIDE, SIDE)


def measure(count: int) -> tuple[list[dict[str, Any]], int]:
    """What is found in each unit, and the Gaussian with most errors where the unit is
    1.
    """
    scene = shell(10_000)
    camera = camera_of(SIZE)
    worst = (0, 0)
    chosen = np.random.default_rng(0).choice(len(scene), count, replace=False)
    rows = []
    with torch.no_grad():
        reference = Renderer(RenderSettings(method="ray"))(scene, camera)
        for unit in UNITS:
            splat, view = in_unit(scene, camera, unit)
            missed = 0
            extra = 0
            inside = 0
            outside = 0
            for number in chosen:
                expected, hit = hits(
                    splat.select(torch.tensor([int(number)])), view.position.numpy()
                )
                missed = missed + int((expected & ~hit).sum())
                extra = extra + int((hit & ~expected).sum())
                inside = inside + int(expected.sum())
                outside = outside + int((~expected).sum())
                if unit == 1:
                    worst = max(worst, (int((expected != hit).sum()), int(number)))
                else:
                    worst = worst
            near = 0.2 * unit
            rows.append(
                {
                    "unit": unit,
                    "missed": missed / inside,
                    "met_in_error": extra / outside,
                    "volprim_psnr": float(
                        psnr(Volprim(RenderSettings(near=near))(splat, view), reference)
                    ),
                    "ray_psnr": min(
                        float(psnr(_ray(near)(splat, view), reference)), SAME
                    ),
                }
            )
    return rows, worst[1]


def _ray(near: float) -> Renderer:
    return Renderer(RenderSettings(method="ray", near=near))


def draw(number: int, path: Path) -> None:
    """The rays around a Gaussian in three units: white where both say that it is met,
    red and blue in case of error.
    """
    import matplotlib.pyplot as plt

    scene = shell(10_000).select(torch.tensor([number]))
    figure, axes = plt.subplots(1, 3, figsize=(8, 3.2))
    for axis, unit in zip(axes, (0.1, 1.0, 10.0), strict=True):
        splat, view = in_unit(scene, camera_of(SIZE), unit)
        expected, hit = hits(splat, view.position.numpy())
        colours = np.zeros((SIDE, SIDE, 3))
        colours[expected & hit] = 1.0
        colours[expected & ~hit] = (0.85, 0.15, 0.15)
        colours[~expected & hit] = (0.2, 0.45, 0.9)
        axis.imshow(colours)
        axis.set_title(f"lengths times {unit:g}")
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--count", type=int, default=100, help="Gaussians that rays are sent to"
    )
    parser.add_argument(
        "--image", type=Path, help="draw the rays around the worst of them"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    variant.use()
    rows, worst = measure(arguments.count)
    if arguments.image:
        draw(worst, arguments.image)
    if arguments.json:
        print(json.dumps(rows, indent=2))  # noqa: T201
        return
    for row in rows:
        ray = "the same" if row["ray_psnr"] == SAME else f"{row['ray_psnr']:.1f} dB"
        print(  # noqa: T201
            f"lengths times {row['unit']:<6g} missed {row['missed']:6.1%}, met in error"
            f" {row['met_in_error']:6.1%}; volprim_rf_basic {row['volprim_psnr']:.1f}"
            f" dB, splat_ray {ray}"
        )


if __name__ == "__main__":
    main()
