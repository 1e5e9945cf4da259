"""What numbers the options of every command take: those of `mi_splat.cli`, and those of attacks and detectors."""

from __future__ import annotations

from mi_splat.cli.ranges import FRACTION, POSITIVE_FRACTION, RANGES, SEED, Range, above, at_least

ALL_RANGES: dict[str, Range] = {
    **RANGES,
    # DAGGER
    "eps": at_least(0, "units of the splat file", "5 is the paper's"),
    "confidence": FRACTION,
    "min_confidence": FRACTION,
    "step_factor": above(0, do="2 is the paper's"),
    "restarts": at_least(1),
    "required_views": POSITIVE_FRACTION,
    "noise_draws": at_least(0),
    # studies
    "seeds": Range(0, SEED.high, unit="whole"),
    "every": at_least(1, "cameras"),
    "port": Range(0, 65535, do="0 takes a free one"),
    # detectors
    "validate_every": at_least(1, "epochs"),
    "processes": Range(0, 1024),
    "threads": Range(1, 1024),
    "pictures": at_least(0),
    "splats": at_least(0),
    "scenes": at_least(0),
    "objects": at_least(0),
    "shots": at_least(1),
    "sky": at_least(0),
    "surroundings": at_least(0),
    "overhead": at_least(0),
    "streets": at_least(0),
    "street_splats": at_least(0),
    "backgrounds": at_least(0),
    "validation_backgrounds": at_least(0),
    "validation": at_least(1),
    "pretraining": at_least(0),
    "batch": at_least(1, "pictures"),
    "epochs": at_least(1),
    "ema_decay": Range(0, 1, open_high=True),
    "final_fraction": FRACTION,
    "learning_rate": above(0),
    "low_resolution": at_least(1, "pixels"),
    "low_resolution_fraction": FRACTION,
    "max_gradient_norm": above(0),
    "warm_up": FRACTION,
    "weight_decay": at_least(0),
}
"""Name of an option to the numbers that it takes."""
