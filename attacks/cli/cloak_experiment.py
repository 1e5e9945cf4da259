"""`mi-splat cloak-experiment`: experiments that explain a figure of a CLOAK study; each prints one JSON document."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from attacks.cli.options import Detectors
from mi_splat import provenance
from mi_splat.cli.console import Advance, follow, limit_threads, progress, show_json
from mi_splat.cli.flags import Positional
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import Called, Folder, at_least
from mi_splat.io.parsing import read_json

if TYPE_CHECKING:
    from attacks.cloak.config import StudyConfig
    from attacks.cloak.steps import StudySteps
    from attacks.detectors.base import Detector


EXAMPLES = (
    "cloak-experiment surroundings scenes/cloak_demo.toml --results out/cloak",
    "cloak-experiment detection-curve scenes/cloak_demo.toml --results out/cloak --every 1 --out out/curve",
)
SEE_ALSO = ("cloak",)


ExperimentName = Literal[
    "surroundings",
    "distance",
    "formats",
    "renderers",
    "street",
    "transition-limit",
    "paint-direction",
    "perfect-splat",
    "detection-curve",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class CloakExperimentOptions:
    """Explain a figure of a CLOAK study.

    surroundings: how far the cloaked splat is from the clean one beside the object. distance: from how many cameras the
    object is found when they stand nearer or farther away. formats and renderers: whether the cloaked splat hides its
    object after other file formats, and in other renderers. street: whether it does so on a path-traced street of
    meshes, by the hour of the day. transition-limit: how sharply colour alone can switch. paint-direction: from where a
    painted sign is seen best. perfect-splat: the rates of a splat that shows its attacks perfectly, from path-traced
    pictures of them. detection-curve: from where detectors find the object in path-traced pictures, on the clean and on
    the cloaked splats; writes a table, plots and pictures into --out.
    """

    experiment: Positional[ExperimentName]
    """Which experiment."""
    study: Positional[Path]
    """TOML file of the study."""
    results: Folder | None = None
    """Folder that `mi-splat cloak` has written for this study; of transition-limit, what is drawn beside the limit."""
    every: Annotated[int, at_least(1, "cameras")] = 4
    """Use each so manieth of the held-out cameras, where an experiment looks from them."""
    detectors: Detectors = ()
    """Names of detectors in the place of those of the study, where an experiment has some."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    stages: Folder | None = None
    """Folder of the study's stages; None is a folder in --results (detection-curve, perfect-splat)."""
    out: Annotated[Path, Called("PATH")] | None = None
    """What is written: a folder (detection-curve), a PNG file with the limit (transition-limit), or a JSON file."""


JSON, PNG = ".json", ".png"
_LOOKS = ("results", "every", "detectors")
_USED = {
    "surroundings": ("results", "every"),
    "distance": _LOOKS,
    "formats": _LOOKS,
    "renderers": _LOOKS,
    "street": _LOOKS,
    "transition-limit": ("results",),
    "paint-direction": (),
    "perfect-splat": ("every", "detectors", "stages"),
    "detection-curve": (*_LOOKS, "stages"),
}
"""The flags that an experiment heeds, besides the study, --weights and --out."""


def run(options: CloakExperimentOptions) -> int:
    """Do one experiment, print what it found, and with --out keep it."""
    from attacks.cloak.config import read_study
    from mi_splat.io.documents import save_json
    from mi_splat.io.folders import check_new_file

    limit_threads(1)
    study = read_study(options.study)
    out = None if options.experiment == "detection-curve" else options.out  # a folder, which it makes itself
    if out is not None:
        endings = (JSON, PNG) if options.experiment == "transition-limit" else (JSON,)
        check_new_file(out, endings, force=None)
    with progress(options.experiment) as advance:
        figures, detectors = _figures(options, study, advance)
    document = {**_origin(options, study), "found": figures, "detectors": detectors}
    if out is not None and out.suffix != PNG:
        save_json(document, out)
    show_json(document)
    return 0


def _origin(options: CloakExperimentOptions, study: StudyConfig) -> dict[str, Any]:
    """What every document says of the experiment: the study, the flags, versions."""
    given = {name: getattr(options, name) for name in ("results", "every", "detectors", "stages")}
    return {
        "study": study.name,
        "experiment": options.experiment,
        "settings": {
            name: str(value) if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value
            for name, value in given.items()
            if value is not None and name in _USED[options.experiment]
        },
        "configuration": asdict(study),
        **provenance.origin(),
    }


def _figures(options: CloakExperimentOptions, study: StudyConfig, advance: Advance) -> tuple[Any, dict[str, str]]:
    """What was measured, and the fingerprints of the detectors that looked."""
    from attacks.cloak.elsewhere import (
        measure_distances,
        measure_formats,
        measure_renderers,
        measure_street,
        measure_surroundings,
        renderers_of,
    )
    from attacks.cloak.path_traced import measure_paint_directions, measure_perfect_splat
    from attacks.cloak.setup import near_of, target_of
    from mi_splat.io import load_splat
    from mi_splat.rendering import Renderer, RenderSettings

    if options.experiment == "paint-direction":
        return measure_paint_directions(study), {}
    if options.experiment == "transition-limit":
        return _transition_limit(options, study), {}
    if options.experiment == "perfect-splat":
        detectors = _detectors(options, study)
        fingerprints = {detector.name: detector.fingerprint for detector in detectors}
        steps = _steps(options, study, advance)
        return measure_perfect_splat(steps, detectors, every=options.every), fingerprints
    if options.results is None:
        do = "pass the folder that mi-splat cloak has written"
        raise InvalidValueError(message("--results", "a folder with clean.ply and cloaked.ply", "none", do))
    if options.experiment == "detection-curve":
        curve = _detection_curve(options, study, options.results, advance)
        return curve, curve["detectors"]
    splats = {name: load_splat(options.results / f"{name}.ply") for name in ("clean", "cloaked")}
    settings = RenderSettings(background=study.scene.background, near=near_of(study, target_of(study.scene)))
    render = Renderer(settings)
    if options.experiment == "surroundings":
        return measure_surroundings(study, splats, render=render, every=options.every), {}
    detectors = _detectors(options, study)
    fingerprints = {detector.name: detector.fingerprint for detector in detectors}
    if options.experiment == "formats":
        rows = measure_formats(study, splats["cloaked"], detectors, render=render, every=options.every)
    elif options.experiment == "street":
        rows = measure_street(study, splats, detectors, every=options.every)
    elif options.experiment == "renderers":
        rows = measure_renderers(study, splats, detectors, renderers_of(settings), every=options.every)
    else:
        rows = measure_distances(study, splats, detectors, render=render, every=options.every)
    return rows, fingerprints


def _transition_limit(options: CloakExperimentOptions, study: StudyConfig) -> dict[str, Any]:
    """The limits, and with --out a figure of them, beside the transition of finished results if they are named."""
    from attacks.cloak.plots import need_matplotlib
    from attacks.cloak.study import SUMMARY
    from attacks.cloak.switch_limit import (
        measure_band_limit,
        measure_layer_limit,
        measure_transition_limit,
        write_limit_figure,
    )

    figure = options.out if options.out is not None and options.out.suffix == PNG else None
    measured = None
    if figure is not None:
        need_matplotlib()
        measured = None if options.results is None else read_json(options.results / SUMMARY).get("transition")
    limits = {
        "one_layer": measure_transition_limit(study),
        "two_layers": measure_layer_limit(study),
        "bands": measure_band_limit(study),
    }
    if figure is not None:
        write_limit_figure(study, limits, measured, figure)
    return limits


def _detectors(options: CloakExperimentOptions, study: StudyConfig) -> list[Detector]:
    from attacks.cli.names import load_detectors

    return load_detectors(options.detectors or study.evaluation.detectors, options.weights)


def _detection_curve(
    options: CloakExperimentOptions, study: StudyConfig, results: Path, advance: Advance
) -> dict[str, Any]:
    """Look, write the folder, and return its rates by region; what was seen stays among the stages."""
    from attacks.cloak.detection_curve import FILES, check_results, watch, write_detection_curve
    from attacks.cloak.plots import need_matplotlib
    from mi_splat.io.folders import check_new_folder, new_folder

    if options.out is None:
        raise InvalidValueError(message("--out", "a folder to write into", "none", "name one"))
    check_new_folder(options.out)
    need_matplotlib()
    check_results(study, results)
    steps = _steps(options, study, advance)
    splats, detectors = steps.finished_splats(), _detectors(options, study)
    rows = watch(steps, splats, detectors, every=options.every)
    with new_folder(options.out, record=FILES[0]) as folder:
        document = write_detection_curve(
            steps, rows, splats, detectors, folder, every=options.every, origin=_origin(options, study)
        )
    rates = [row for row in document["rates"] if row["by"] == "region" and row["seed"] is None]
    conditions = {name: document[name] for name in ("cameras", "detectors", "splats")}
    return {**conditions, "rates": rates, "out": str(options.out), "files": list(FILES)}


def _steps(options: CloakExperimentOptions, study: StudyConfig, advance: Advance) -> StudySteps:
    from attacks.cli.names import weights_of
    from attacks.cloak.steps import StudySteps

    names = options.detectors or study.evaluation.detectors
    weights = weights_of(names, options.weights)
    return StudySteps(study=study, folder=_stages(options), weights=weights, on_step=follow(advance))


def _stages(options: CloakExperimentOptions) -> Path:
    if options.stages is not None:
        return options.stages
    if options.results is None:
        do = "name the one of the study, or a new one, for path-traced pictures to stay in"
        raise InvalidValueError(message("--stages", "a folder", "none", do))
    return options.results / "stages"
