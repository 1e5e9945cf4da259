"""`mi-splat plot-detector-training`: draw losses and validation mAP of a training by epoch."""

from __future__ import annotations

from attacks.cli.training_options import PlotDetectorTrainingOptions
from attacks.detectors.training.curves import draw_curves
from mi_splat.cli.console import show


def run(options: PlotDetectorTrainingOptions) -> int:
    """Draw one picture."""
    figure = draw_curves(options.curves)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out)
    show(str(options.out))
    return 0
