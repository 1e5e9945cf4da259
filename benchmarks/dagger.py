"""A step and a whole search of DAGGER on `fasterrcnn_small`:
`python benchmarks/cpu_time.py benchmarks/dagger.py`.

With `--against REVISION` beside the code of another revision. In a step from the clean
splat nothing comes near the wanted class; the search is the paper's, so it has steps of
both sorts, and what it prepares.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

from attacks.dagger.attack import problem_of
from attacks.dagger.config import DaggerConfig
from attacks.dagger.search import search
from attacks.dagger.views import FixedViews
from attacks.detectors.registry import as_detectors
from attacks.objectives.relabel import relabel
from mi_splat import read_scene
from mi_splat.render.renderer import Renderer

SCENES = Path("scenes").resolve()
PAIRS = {
    "car to person": ("car_street", "car", "person"),
    "sign to bird": ("stop_sign", "stop_sign", "bird"),
}


def runs() -> dict[str, Callable[[], object]]:
    """What is timed."""
    config = DaggerConfig()
    detectors = as_detectors("fasterrcnn_small")
    made = dict[str, Callable[[], object]]()
    for name, (scene, object_name, target) in PAIRS.items():
        loaded = read_scene(SCENES / f"{scene}.xml")
        camera = next(iter(loaded.cameras.values()))
        render = Renderer(loaded.settings)
        views = FixedViews(
            loaded.scene, loaded.objects[object_name], camera, render=render
        )
        problem = problem_of(views, detectors, relabel(target), config)
        clean = problem.subset.parameters(config.attributes)
        prepared = dataclasses.replace(problem, frozen=views.frozen(config))
        made[f"step, {name}"] = functools.partial(
            prepared.evaluate, clean, views.held_out(config), config
        )
        made[f"search, {name}"] = functools.partial(search, problem, views, config)
    return made
