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
    # distributions of views
    "azimuths": Range(-360, 720, unit="degrees"),
    "elevations": Range(-90, 90, unit="degrees"),
    "distances": above(0, "times the reference camera's"),
    "distance_unit": above(0, "world units"),
    "roll": Range(0, 180, unit="degrees"),
    "fovs": Range(0, 179, open_low=True, unit="degrees"),
    "aim": at_least(0, "radii of the object"),
    "least_visible": FRACTION,
    "exposure": at_least(0, "stops"),
    "white_balance": Range(0, 1, open_high=True),
    "gamma": at_least(0),
    "blur": at_least(0, "pixels"),
    "resize": POSITIVE_FRACTION,
    "noise": at_least(0),
    "jpeg": Range(0, 95, unit="quality", do="0 is no JPEG"),
    "momentum": Range(0, 1, open_high=True),
    "pool": at_least(0, "views", "0 draws new ones at each step"),
    "stop_at": POSITIVE_FRACTION,
    "held_out": at_least(1, "views"),
    "judge_seed": SEED,
    "pairs": Range(0, 5, unit="whole"),
    # studies
    "seeds": Range(0, SEED.high, unit="whole"),
    "every": at_least(1, "cameras"),
    "port": Range(0, 65535, do="0 takes a free one"),
    # detectors
    "validate_every": at_least(1, "epochs or steps"),
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
