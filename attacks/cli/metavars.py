"""What `--help` calls the values of options: words that mean something in place of FLOAT, INT, STR and PATH.

One table for every command, by the name of the option, as the table of ranges is. Where one name means two things, the
name of the dataclass stands before it. Of several words there are as many as the option has values.
"""

from __future__ import annotations

import re

KINDS = {"FLOAT": "NUMBER", "INT": "COUNT", "STR": "NAME", "PATH": "FILE"}
"""What the type of a value says of it, and what it is called where the table has nothing better."""

_TYPE = re.compile(rf"\b({'|'.join(KINDS)})\b")

METAVARS: dict[str, tuple[str, ...]] = {
    # cameras and pictures
    "cameras": ("CAMERAS",),
    "azimuth": ("DEGREES",),
    "elevation": ("DEGREES",),
    "distance": ("LENGTH",),
    "near": ("LENGTH",),
    "centre": ("X Y Z",),
    "fov": ("DEGREES",),
    "fps": ("RATE",),
    "ViewOptions.views": ("AZIMUTHS ELEVATIONS",),
    "ViewOptions.path": ("RESULT",),
    # selection
    "box": ("X0 Y0 Z0 X1 Y1 Z1",),
    "box_rotation": ("YAW PITCH ROLL",),
    "click": ("X,Y",),
    "cluster": ("RANK",),
    "link_distance": ("FACTOR",),
    "link_colour": ("DIFFERENCE",),
    # capture
    "CaptureOptions.scene": ("SCENE",),
    "CaptureOptions.cameras": ("CAMERAS",),
    "rotate": ("X Y Z",),
    "scale": ("METRES",),
    "sun": ("AZIMUTH,ELEVATION",),
    # training
    "dataset": ("FOLDER",),
    "start": ("FILE",),
    "iterations": ("STEPS",),
    "checkpoint_every": ("STEPS",),
    "eval_interval": ("STEPS",),
    "sh_degree": ("DEGREE",),
    "sh_degree_interval": ("STEPS",),
    "downscale": ("FACTOR",),
    "lambda_dssim": ("WEIGHT",),
    **dict.fromkeys(
        ("lr_means", "lr_means_final", "lr_scales", "lr_rotations", "lr_opacities", "lr_sh", "lr_sh_final"), ("RATE",)
    ),
    **dict.fromkeys(("densify_from", "densify_until", "densify_interval", "opacity_reset_interval"), ("STEPS",)),
    "densify_grad_threshold": ("GRADIENT",),
    "percent_dense": ("SHARE",),
    "prune_opacity": ("OPACITY",),
    "dead_opacity": ("OPACITY",),
    "prune_scale": ("SHARE",),
    "noise_lr": ("RATE",),
    "opacity_reg": ("WEIGHT",),
    "scale_reg": ("WEIGHT",),
    "growth": ("SHARE",),
    "seed": ("SEED",),
    "seeds": ("SEED",),
    # distributions of views
    **dict.fromkeys(("azimuths", "elevations", "fovs"), ("LEAST MOST",)),
    "distances": ("LEAST MOST",),
    "distance_unit": ("LENGTH",),
    "roll": ("DEGREES",),
    "aim": ("FRACTION",),
    "exposure": ("STOPS",),
    "blur": ("PIXELS",),
    "resize": ("FACTOR",),
    "jpeg": ("QUALITY",),
    "stop_at": ("FRACTION",),
    "EotConfig.validate_every": ("STEPS",),
    "judge_seed": ("SEED",),
    # comparison of renderers
    "methods": ("METHOD",),
    "rounds": ("COUNT",),
    "amplify": ("FACTOR",),
    # attacks
    "eps": ("RADIUS",),
    "steps": ("STEPS",),
    "step_factor": ("FACTOR",),
    "required_views": ("FRACTION",),
    "required_detectors": ("FRACTION",),
    "confidence": ("CONFIDENCE",),
    "min_confidence": ("CONFIDENCE",),
    "original": ("CLASS",),
    "target": ("CLASS",),
    "detectors": ("DETECTOR",),
    "get": ("DETECTOR",),
    "stages": ("FOLDER",),
    "results": ("FOLDER",),
    "store": ("FOLDER",),
    "scheduler": ("ADDRESS",),
    "reason": ("TEXT",),
    "sbatch": ("OPTION",),
    "DaggerTransferOptions.scenes": ("FOLDER",),
    "DaggerTransferOptions.views": ("COUNT",),
    "eot_study": ("FOLDER",),
    "DaggerTransferOptions.seeds": ("COUNT",),
    "DaggerSanityOptions.seeds": ("COUNT",),
    "surrogate": ("DETECTOR",),
    "judges": ("DETECTOR",),
    "DaggerEotStudyOptions.scenes": ("FOLDER",),
    "DaggerEotStudyOptions.groups": ("TABLE",),
    "pairs": ("NUMBER",),
    "ArtifactOptions.result": ("RESULT",),
    "ArtifactOptions.page": ("PAGE",),
    "folders": ("FOLDER",),
    "ArtifactCheckOptions.pages": ("FOLDER",),
    "ArtifactCheckOptions.splats": ("FOLDER",),
    "rate_tolerance": ("FRACTION",),
    "host": ("HOST",),
    "port": ("PORT",),
    # training of detectors
    "data": ("FOLDER",),
    "epochs": ("EPOCHS",),
    "validate_every": ("EPOCHS",),
    "batch": ("PICTURES",),
    "low_resolution": ("PIXELS",),
    "low_resolution_fraction": ("FRACTION",),
    "final_fraction": ("FRACTION",),
    "warm_up": ("FRACTION",),
    "learning_rate": ("RATE",),
    # what is written
    "out": ("FOLDER",),
    "RenderOptions.out": ("PATH",),
    "SelectOptions.out": ("FILE",),
    "ConvertOptions.out": ("FILE",),
    "EvaluateDetectorOptions.out": ("FILE",),
    "CompareDetectorsOptions.out": ("FILE",),
    "PlotDetectorTrainingOptions.out": ("FILE",),
}
"""Name of an option to what its values are called; several where the option takes other numbers of values elsewhere."""


def metavar(owner: str, name: str, given: str) -> str:
    """What the values of an option are called.

    Args:
        owner: Name of the dataclass that has the option.
        name: Of the option, with underscores.
        given: What they would be called by their types, for instance "[PATH ...]".
    """
    count = len(_TYPE.findall(given))
    known = METAVARS.get(f"{owner}.{name}", METAVARS.get(name, ()))
    words = iter(next((entry.split() for entry in known if len(entry.split()) == count), ()))
    return _TYPE.sub(lambda kind: next(words, KINDS[kind[0]]), given)
