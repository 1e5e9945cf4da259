"""A comparison as JSON can hold it."""

from collections.abc import Mapping
from typing import Any

from mi_splat.comparison.compare import FORWARD, GRADIENT, Comparison
from mi_splat.comparison.measures import PictureDistance
from mi_splat.comparison.methods import Method


def as_dict(comparison: Comparison, methods: Mapping[str, Method]) -> dict[str, Any]:
    """What was measured, as JSON can hold it; a figure that was not measured is null."""
    costs = {
        kind: {name: cost.as_dict() for name, cost in by_method.items()} for kind, by_method in comparison.costs.items()
    }
    return {
        "methods": {
            name: {
                "differentiable": method.differentiable,
                "bits": method.bits,
                "first_seconds": comparison.first_seconds.get(name),
                **{kind: costs.get(kind, {}).get(name) for kind in (FORWARD, GRADIENT)},
            }
            for name, method in methods.items()
        },
        "pairs": [
            {
                "methods": list(names),
                "bits": pair.bits,
                **_figures(pair.whole),
                "by_camera": {view: _figures(distance) for view, distance in pair.distances.items()},
                "gradients": None
                if pair.agreement is None
                else {
                    attribute: {
                        "cosine": agreement.cosine,
                        "median_cosine": agreement.median_cosine,
                        "relative_error": agreement.relative_error,
                    }
                    for attribute, agreement in pair.agreement.items()
                },
            }
            for names, pair in comparison.pairs.items()
        ],
    }


def _figures(distance: PictureDistance) -> dict[str, float | None]:
    return {"psnr": distance.psnr, "mse": distance.mse, "ssim": distance.ssim, "lpips": distance.lpips}
