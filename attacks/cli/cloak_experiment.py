"""`mi-splat cloak-experiment`: experiments that explain a figure of a CLOAK study; each prints one JSON document."""

from __future__ import annotations

from attacks.cli.options import CloakExperimentOptions
from attacks.cloak.experiments.distance import measure_distances
from attacks.cloak.experiments.paint_direction import measure_paint_directions
from attacks.cloak.experiments.surroundings import measure_surroundings
from attacks.cloak.experiments.transition_limit import measure_transition_limit
from attacks.cloak.study.setup import near_of, target_of
from attacks.cloak.study.study_file import read_study
from attacks.detectors import load_detector
from mi_splat.cli.console import limit_threads, progress, show_json
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat
from mi_splat.rendering import Renderer, RenderSettings


def run(options: CloakExperimentOptions) -> int:
    """Do one experiment and print what it found."""
    limit_threads(1)
    study = read_study(options.study)
    with progress(options.experiment):
        if options.experiment == "paint-direction":
            found = measure_paint_directions(study)
        elif options.experiment == "transition-limit":
            found = measure_transition_limit(study)
        else:
            if options.results is None:
                do = "pass the folder that mi-splat cloak has written"
                raise InvalidValueError(message("--results", "a folder with clean.ply and cloaked.ply", "none", do))
            splats = {name: load_splat(options.results / f"{name}.ply") for name in ("clean", "cloaked")}
            near = near_of(study, target_of(study.scene))
            render = Renderer(RenderSettings(background=study.scene.background, near=near))
            if options.experiment == "surroundings":
                found = measure_surroundings(study, splats, render=render, every=options.every)
            else:
                detectors = [load_detector(name) for name in study.evaluation.detectors]
                found = measure_distances(study, splats, detectors, render=render, every=options.every)
    show_json({"study": study.name, "experiment": options.experiment, "found": found})
    return 0
