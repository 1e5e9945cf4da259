"""A step and a whole search of DAGGER on `fasterrcnn_small`: `python benchmarks/cpu_time.py benchmarks/dagger.py`.

With `--against REVISION` beside the code of another revision. In a step from the clean splat nothing comes near the
wanted class; the search is the paper's, so it has steps of both sorts, and what it prepares.
"""

import functools
from collections.abc import Callable
from pathlib import Path

from attacks.dagger.attack import fixed_problem
from attacks.dagger.config import DaggerConfig
from attacks.dagger.search import frozen, search_fixed
from attacks.detectors.registry import as_detectors
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import relabel
from mi_splat import read_scene
from mi_splat.rendering import Renderer

SCENES = Path("scenes").resolve()
PAIRS = {"car to person": ("car_street", "car", "person"), "sign to bird": ("stop_sign", "stop_sign", "bird")}


def runs() -> dict[str, Callable[[], object]]:
    """What is timed."""
    config, detectors, made = DaggerConfig(), as_detectors("fasterrcnn_small"), dict[str, Callable[[], object]]()
    for name, (scene, object_name, target) in PAIRS.items():
        loaded = read_scene(SCENES / f"{scene}.xml")
        subset = GaussianSubset.of(loaded.scene.with_degree(3), loaded.objects[object_name])
        camera, render = next(iter(loaded.cameras.values())), Renderer(loaded.settings)
        problem, views, _ = fixed_problem(subset, [camera], detectors, relabel(target), render=render)
        clean, prepared = subset.parameters(config.attributes), frozen(problem, views, config)
        made[f"step, {name}"] = functools.partial(prepared.evaluate, clean, views, config)
        made[f"search, {name}"] = functools.partial(search_fixed, problem, views, config, None)
    return made
