"""Makes a splat scene that the project ships, from its meshes:
`python -m scenes.recipes.example_scenes stop_sign`.

`mi_splat.capture.sources` says what the scenes show. NAME.xml, its two splats and
NAME.json, a record with counts, settings, seed and PSNR, are written; with the recipe's
own numbers it takes about a quarter of an hour.
"""

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from mi_splat.cameras.camera import Camera, View, look_at
from mi_splat.cameras.lens import Lens, angle_of
from mi_splat.capture.mesh import Asset
from mi_splat.capture.mitsuba_scene import scene_dict
from mi_splat.capture.sources import EXAMPLES, ExampleScene, Point
from mi_splat.capture.surface_points import nearness, surface_samples
from mi_splat.io import load_splat, save_splat
from mi_splat.maths.metrics import psnr
from mi_splat.maths.rotation import to_matrix
from mi_splat.render.renderer import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene, merge
from mi_splat.training.loop import FitConfig, fit
from mi_splat.training.strategies import ClassicConfig
from scenes.recipes.disc_splats import DiscConfig, disc_splat
from scenes.recipes.mesh_views import capture, depth_maps
from scenes.recipes.objects.examples import car_street, roadside
from scenes.recipes.objects.primitives import ellipsoid

SIZE = 256
FOCAL = 256.0
HELD_OUT = 12
"""Edge of the images and focal length in pixels, and number of images that take no
part.
"""
_GOLDEN_RATIO = 0.6180339887498949
"""The additive recurrence with this step spreads points over [0, 1) more evenly than
any other (Niederreiter 1992).
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneRecipe:
    """How a splat of one of the project's mesh scenes is made, and where its cameras
    stand.
    """

    source: ExampleScene
    # whose textures are not rounded to 8 bits, as those of the files are
    assets: Callable[[], tuple[Asset, Asset]]
    target: str
    surroundings: str
    sensors: dict[str, Point]
    distance: tuple[float, float]
    elevation: tuple[float, float]
    azimuth: tuple[float, float]
    counts: tuple[int, int, int]
    views: int
    steps: int
    limit: int


def around(azimuth: float, elevation: float, distance: float) -> Point:
    """Offset of a camera from the centre, rounded to millimetres: angles in degrees,
    distance in metres.
    """
    a = math.radians(azimuth)
    e = math.radians(elevation)
    x = math.cos(e) * math.cos(a)
    y = math.cos(e) * math.sin(a)
    z = math.sin(e)
    return round(distance * x, 3), round(distance * y, 3), round(distance * z, 3)


RECIPES = {
    "car_street": SceneRecipe(
        source=EXAMPLES["car_street"],
        assets=car_street,
        target="car",
        surroundings="street",
        sensors={
            "front": around(5, 8, 5.4),
            "three_quarter": around(-38, 14, 5.6),
            "side": around(-92, 9, 6.0),
            "rear": around(152, 16, 5.6),
            "high": around(55, 42, 6.0),
            "top": around(20, 80, 6.2),
        },
        distance=(4.8, 8.0),
        elevation=(2, 85),
        azimuth=(0, 360),
        counts=(16_000, 60_000, 1_500),
        views=96,
        steps=7000,
        limit=48_000,
    ),
    "stop_sign": SceneRecipe(
        source=EXAMPLES["stop_sign"],
        assets=roadside,
        target="stop_sign",
        surroundings="roadside",
        sensors={
            "front": around(0, 2, 1.7),
            "left": around(38, 4, 1.7),
            "right": around(-35, 0, 1.7),
            "low": around(12, -22, 1.8),
            "high": around(-15, 35, 1.8),
            "far": around(8, 3, 2.8),
        },
        distance=(1.4, 3.4),
        elevation=(-20, 55),
        azimuth=(-62, 62),
        counts=(6_000, 60_000, 1_500),
        views=80,
        steps=7000,
        limit=24_000,
    ),
}


def _camera(origin: NDArray[np.float64], target: NDArray[np.float64]) -> Camera:
    return Camera(
        to_world=look_at(origin.tolist(), target.tolist()),
        lens=Lens(focal=FOCAL, size=(SIZE, SIZE)),
    )


def sensors(recipe: SceneRecipe) -> dict[str, Camera]:
    """The named cameras of a scene file."""
    centre = np.array(recipe.source.centre)
    return {
        name: _camera(centre + offset, centre)
        for name, offset in recipe.sensors.items()
    }


def random_cameras(recipe: SceneRecipe, count: int, *, seed: int) -> list[Camera]:
    """`count` cameras in the recipe's range, evenly spread in area with some chance,
    that look at about its centre.
    """
    rng = np.random.default_rng([seed, 0xCA3])
    low, high = np.sin(np.radians(recipe.elevation))
    cameras = []
    for i in range(count):
        elevation = math.degrees(math.asin(low + (high - low) * ((i + 0.5) / count)))
        fraction = (i * _GOLDEN_RATIO + rng.random() / count) % 1
        azimuth = recipe.azimuth[0] + fraction * (recipe.azimuth[1] - recipe.azimuth[0])
        offset = np.array(around(azimuth, elevation, rng.uniform(*recipe.distance)))
        origin = np.array(recipe.source.centre) + offset
        origin[2] = max(origin[2], 0.3)
        target = np.array(recipe.source.centre) + rng.normal(
            0, 0.05, 3
        ) * np.linalg.norm(offset)
        cameras.append(_camera(origin, target))
    return cameras


def _dome() -> Asset:
    """The sky as a surface: the upper half of a sphere far behind everything."""
    whole = ellipsoid((440.0, 440.0, 440.0), (0.6, 0.7, 0.8), segments=48)
    upper = whole.faces[whole.vertices[whole.faces][..., 2].min(1) > -30]
    return Asset("sky", (type(whole)(whole.vertices, upper, whole.uvs, whole.texture),))


def start_splat(
    recipe: SceneRecipe, views: Sequence[View], depths: Sequence[Tensor], *, seed: int
) -> tuple[GaussianScene, GaussianScene]:
    """Untrained splats of the target and of its surroundings, sky included."""
    target, surroundings = recipe.assets()
    density = nearness([view.camera for view in views][:: max(1, len(views) // 24)])
    parts = []
    for asset, count, overlap in zip(
        (target, surroundings, _dome()), recipe.counts, (0.6, 0.62, 0.9), strict=True
    ):
        even = asset is target or asset.name == "sky"
        samples = surface_samples(
            asset, count, density=None if even else density, seed=seed
        )
        parts.append(
            disc_splat(samples, views, depths, config=DiscConfig(overlap=overlap))
        )
    return parts[0], merge(parts[1], parts[2])


def fit_config(steps: int, limit: int) -> FitConfig:
    """The classic recipe for Gaussians that begin on the surfaces.

    Nothing floats that a reset of the opacities would remove, and the sky, which is far
    and large, has to stay.
    """
    strategy = ClassicConfig(
        max_gaussians=limit, opacity_reset_interval=0, prune_scale=1e9
    )
    return FitConfig(
        iterations=steps,
        strategy=strategy,
        sh_degree=1,
        sh_degree_interval=0,
        lr_sh_divisor=20,
        eval_interval=0,
    )


def belongs(
    scene: GaussianScene, target: GaussianScene, others: GaussianScene
) -> Tensor:
    """(N,) bool, which Gaussians are the target's after training, which has moved,
    cloned and split them, but not far.

    Those whose centre, and both ends of the longest axis at one standard deviation, lie
    nearest to one that was the target's at first: what reaches over into the
    surroundings is theirs.
    """
    starts = cKDTree(merge(target, others).means.numpy())
    longest = scene.scales.argmax(1)
    rows = torch.arange(len(scene))
    axis = (
        to_matrix(scene.rotations)[rows, :, longest] * scene.scales[rows, longest, None]
    )
    ends = (scene.means, scene.means - axis, scene.means + axis)
    nearest = [torch.from_numpy(starts.query(points.numpy())[1]) for points in ends]
    return torch.stack([numbers < len(target) for numbers in nearest]).all(0)


def scene_xml(name: str, recipe: SceneRecipe) -> str:
    """The scene file in Mitsuba's XML."""
    lines = ['<scene version="3.0.0">', '    <integrator type="splat_tile"/>', ""]
    for shape in (recipe.surroundings, recipe.target):
        lines += [
            f'    <shape type="gaussians" id="{shape}">',
            f'        <string name="filename" value="{name}_{shape}.ply"/>',
            "    </shape>",
        ]
    centre = np.array(recipe.source.centre)
    fov = math.degrees(angle_of(FOCAL, SIZE))
    for sensor, offset in recipe.sensors.items():
        origin = ", ".join(f"{v:.6g}" for v in centre + offset)
        target = ", ".join(f"{v:.6g}" for v in centre)
        lines += [
            "",
            f'    <sensor type="perspective" id="{sensor}">',
            '        <string name="fov_axis" value="x"/>',
            f'        <float name="fov" value="{fov:.10g}"/>',
            '        <transform name="to_world">',
            f'            <lookat origin="{origin}" target="{target}" up="0, 0, 1"/>',
            "        </transform>",
            '        <film type="hdrfilm">',
            f'            <integer name="width" value="{SIZE}"/>',
            f'            <integer name="height" value="{SIZE}"/>',
            '            <rfilter type="box"/>',
            "        </film>",
            "    </sensor>",
        ]
    return "\n".join([*lines, "</scene>", ""])


def make(
    name: str,
    folder: Path,
    *,
    views: int | None = None,
    samples: int = 16,
    steps: int | None = None,
    seed: int = 0,
) -> dict[str, object]:
    """Make one scene: two splat files, the scene file and a record of how it was made
    and how good it is.
    """
    recipe = RECIPES[name]
    start = time.time()
    views = recipe.views if views is None else views
    steps = recipe.steps if steps is None else steps
    folder.mkdir(parents=True, exist_ok=True)
    target, surroundings = recipe.assets()
    description = scene_dict([target], light=recipe.source.light, backdrop=surroundings)
    cameras = random_cameras(recipe, views, seed=seed)
    pictures = capture(description, cameras, samples=samples, seed=seed)
    depths = depth_maps(description, cameras, seed=seed)
    parts = start_splat(recipe, pictures, depths, seed=seed)
    whole = fit(
        pictures,
        merge(*parts),
        render=Renderer(RenderSettings(), screen_gradients=ScreenGradients()),
        config=fit_config(steps, recipe.limit),
        seed=seed,
    ).scene
    is_target = belongs(whole, *parts)
    files = {
        recipe.target: whole.select(is_target),
        recipe.surroundings: whole.select(~is_target),
    }
    for shape, splat in files.items():
        save_splat(splat, folder / f"{name}_{shape}.ply")
    (folder / f"{name}.xml").write_text(scene_xml(name, recipe))
    saved = merge(*(load_splat(folder / f"{name}_{shape}.ply") for shape in files))
    render = Renderer(RenderSettings())
    record = {
        "name": name,
        "gaussians": {shape: len(splat) for shape, splat in files.items()},
        "views": views,
        "samples": samples,
        "steps": steps,
        "seed": seed,
        "psnr_fitted": _mean_psnr(saved, pictures, render),
        **_score(saved, recipe, description, samples=2 * samples, seed=seed + 7919),
        "seconds": round(time.time() - start),
    }
    (folder / f"{name}.json").write_text(json.dumps(record, indent=2) + "\n")
    return record


def _score(
    scene: GaussianScene,
    recipe: SceneRecipe,
    description: dict[str, Any],
    *,
    samples: int,
    seed: int,
) -> dict[str, object]:
    """PSNR over images that took no part: cameras by chance, and the named
    sensors.
    """
    render = Renderer(RenderSettings())
    named = sensors(recipe)
    views = capture(
        description,
        [*random_cameras(recipe, HELD_OUT, seed=seed), *named.values()],
        samples=samples,
        seed=seed,
    )
    at_sensors = zip(named, views[HELD_OUT:], strict=True)
    return {
        "psnr_held_out": _mean_psnr(scene, views[:HELD_OUT], render),
        "psnr_sensors": {
            sensor: _mean_psnr(scene, [view], render) for sensor, view in at_sensors
        },
    }


def _mean_psnr(scene: GaussianScene, views: Sequence[View], render: Renderer) -> float:
    with torch.no_grad():
        values = [
            float(psnr(render(scene, view.camera).clamp(0, 1), view.image))
            for view in views
        ]
    return round(sum(values) / len(values), 2)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=RECIPES)
    parser.add_argument("--out", type=Path, default=Path("scenes"))
    parser.add_argument(
        "--views", type=int, help="images to fit to; the recipe's number by default"
    )
    parser.add_argument(
        "--samples", type=int, default=16, help="samples per pixel in them"
    )
    parser.add_argument(
        "--steps",
        type=int,
        help="steps of the training; the recipe's number by default",
    )
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    made = make(
        given.name,
        given.out,
        views=given.views,
        samples=given.samples,
        steps=given.steps,
        seed=given.seed,
    )
    print(json.dumps(made, indent=2))  # noqa: T201
