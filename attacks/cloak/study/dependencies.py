"""What each stage of a study depends on: the whole of its settings, defaults included, and the content of its inputs.

The functions are pure, so that a test can change one field of a study and see which stages are done anew.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from attacks.cloak.config import AttackConfig, CleaningConfig, StudyConfig, TrainingConfig
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras import Camera
from mi_splat.training.checkpoints import to_json
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import ClassicConfig, FixedConfig, strategy_config

_POISONING_ONLY = ("name", "poison_margin", "poison_fraction", "emphasis", "emphasis_depth", "target_class")
"""Fields of an attack that have no part in what its appearance looks like."""

_REFINE_FROM = 100
"""Step from which Gaussians are added to layers, which begin as a splat that is trained already."""


def fit_config(training: TrainingConfig) -> FitConfig:
    """The trainer's settings."""
    return FitConfig(
        iterations=training.iterations,
        strategy=strategy_config(training.strategy, max_gaussians=training.max_gaussians),
        sh_degree=training.sh_degree,
        sh_degree_interval=training.sh_degree_interval,
        eval_interval=0,
    )


def layered_fit_config(study: StudyConfig) -> FitConfig:
    """How layers are trained: their colours alone, or everything."""
    assert study.layers is not None
    colours = FitConfig(
        iterations=study.layers.iterations,
        trainable=("sh",),
        strategy=FixedConfig(),
        sh_degree=study.layers.making.degree,
        sh_degree_interval=0,
        lr_sh=study.layers.lr_sh,
        lr_sh_final=study.layers.lr_sh_final,
        eval_interval=0,
    )
    if not study.layers.geometry:
        return colours
    strategy = ClassicConfig(
        max_gaussians=study.layers.max_gaussians,
        densify_from=_REFINE_FROM,
        densify_until=study.layers.iterations * 2 // 3,
        opacity_reset_interval=0,
    )
    return replace(colours, trainable=ATTRIBUTES, strategy=strategy)


def of_pictures(study: StudyConfig, source: str) -> dict[str, Any]:
    """The victim's pictures; they are transparent where nothing is, so that the background has no part in them.

    Args:
        study: The study.
        source: Digest of the scene that is photographed (`CaptureSource.digest`).
    """
    return {"source": source, "cameras": asdict(study.cameras), "mitsuba": importlib.metadata.version("mitsuba")}


def of_appearance(study: StudyConfig, source: str, attack: AttackConfig) -> dict[str, Any]:
    """Path-traced pictures of the scene with the object as an attack shows it.

    Args:
        study: The study.
        source: Digest of the scene.
        attack: Whose appearance it is.
    """
    shown = {key: value for key, value in asdict(attack).items() if key not in _POISONING_ONLY}
    # The distance of the cameras and their height place an occluder.
    return {**of_pictures(study, source), "background": study.scene.background, "appearance": shown}


def of_poisoned(
    study: StudyConfig, source: str, pictures: str, seed: int, surrogates: Sequence[str] = ()
) -> dict[str, Any]:
    """A poisoned set.

    Args:
        study: The study.
        source: Digest of the scene.
        pictures: Content of the victim's pictures.
        seed: Draws the cameras of which a part is poisoned; where all of them are, it has no part in the set.
        surrogates: Content of the splats by which the poison is corrected, in the order of the rounds.
    """
    corrected: dict[str, Any] = {}
    if surrogates:
        assert study.surrogate is not None
        corrected = {"surrogates": list(surrogates), "gain": study.surrogate.gain}
    attacks = [{key: value for key, value in asdict(one).items() if key != "target_class"} for one in study.attack]
    drawn = seed if min(one.poison_fraction for one in study.attack) < 1 else None
    return {
        "source": source,
        "pictures": pictures,
        "samples": study.cameras.samples,
        "height": study.cameras.height,
        "background": study.scene.background,
        "attack": attacks,
        "seed": drawn,
        "mitsuba": importlib.metadata.version("mitsuba"),
        **corrected,
    }


def of_splat(study: StudyConfig, pictures: str, seed: int) -> dict[str, Any]:
    """A trained splat.

    Args:
        study: The study.
        pictures: Content of the set that it is trained on.
        seed: Of the training.
    """
    return {
        "pictures": pictures,
        "background": study.scene.background,
        "fit": to_json(fit_config(study.training)),
        "outliers": study.training.outliers,
        "near": study.training.near,
        "seed": seed,
        "point_deviations": study.training.point_deviations,
    }


def of_layers(study: StudyConfig, source: str, clean: str, pictures: str, seed: int) -> dict[str, Any]:
    """The clean splat with the object in layers.

    Args:
        study: The study.
        source: Digest of the scene, whose meshes say where the object is.
        clean: Content of the clean splat.
        pictures: Content of the poisoned set, on which the colours are trained.
        seed: Of the training.
    """
    assert study.layers is not None
    return {
        "source": source,
        "clean": clean,
        "pictures": pictures,
        "background": study.scene.background,
        "near": study.training.near,
        "cameras": asdict(study.cameras),
        "layers": asdict(study.layers),
        "fit": to_json(layered_fit_config(study)),
        "cones": [
            [attack.name, attack.elevation, attack.azimuth]
            for attack in study.attack
            if attack.name in study.layers.attacks
        ],
        "seed": seed,
    }


def of_cleaned(splat: str, cleaning: CleaningConfig) -> dict[str, Any]:
    """A finished splat after a cleaning; steps that are left out have no part in it.

    Args:
        splat: Content of the splat's file.
        cleaning: What is done to it.
    """
    return {"splat": splat, "cleaning": cleaning.steps}


def of_true_pictures(
    study: StudyConfig, source: str, cameras: Sequence[Camera], attack: AttackConfig | None
) -> dict[str, Any]:
    """Path-traced pictures to compare a splat's with.

    Args:
        study: The study.
        source: Digest of the scene.
        cameras: Where from.
        attack: Whose appearance the object has; None is the scene as it is.
    """
    lens = [[c.fx, c.fy, c.cx, c.cy, c.width, c.height] for c in cameras]
    return {
        "source": source,
        "background": study.scene.background,
        "samples": study.cameras.samples,
        "poses": [camera.to_world.flatten().tolist() for camera in cameras],
        "lenses": lens,
        "appearance": None if attack is None else of_appearance(study, source, attack),
        "mitsuba": importlib.metadata.version("mitsuba"),
    }


def of_observations(
    study: StudyConfig, source: str, splat: str, true_pictures: Sequence[str], detectors: Mapping[str, str]
) -> dict[str, Any]:
    """What detectors report of a splat, and how true its pictures are.

    Args:
        study: The study.
        source: Digest of the scene, whose meshes say where the object is.
        splat: Content of the splat's file.
        true_pictures: Content of the pictures that it is compared with.
        detectors: Fingerprint of each detector's weights, by its name.
    """
    evaluation = {key: value for key, value in asdict(study.evaluation).items() if key != "detectors"}
    regions = [
        {key: getattr(attack, key) for key in ("name", "elevation", "azimuth", "target_class")}
        for attack in study.attack
    ]
    return {
        "splat": splat,
        "source": source,
        "background": study.scene.background,
        "near": study.training.near,
        "class": study.scene.class_name,
        "cameras": asdict(study.cameras),
        "evaluation": evaluation,
        "attack": regions,
        "true_pictures": list(true_pictures),
        "detectors": dict(detectors),
    }


def of_view_reports(study: StudyConfig, source: str, pictures: str, detector: tuple[str, str]) -> dict[str, Any]:
    """What one detector reports on the object in a series of pictures from held-out cameras.

    Args:
        study: The study.
        source: Digest of the scene, whose meshes say where the object is.
        pictures: Content of the pictures, or of the splat that they show; and which of the cameras they are from.
        detector: Its name, and the fingerprint of its weights.
    """
    return {
        "source": source,
        "pictures": pictures,
        "background": study.scene.background,
        "near": study.training.near,
        "class": study.scene.class_name,
        "cameras": asdict(study.cameras),
        "held_out": [study.evaluation.cameras, study.evaluation.min_separation],
        "attack": [
            {key: getattr(attack, key) for key in ("name", "elevation", "azimuth", "target_class")}
            for attack in study.attack
        ],
        "detector": list(detector),
    }
