"""Seconds that detectors take for one picture: `python benchmarks/detectors.py
centernet_coco nanodet_coco`.

Forward is `detect`, backward is from all candidates' scores and boxes to the picture.
Detectors take turns, so that all see the same machine; the ratio is to the first one,
the median over the rounds. Processor time is that of all threads together, which other
programs change less than the clock's. Weights must be there.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from attacks.detectors import Detector, load_detector
from mi_splat.render.renderer import Renderer
from mi_splat.render.scene_files import open_scene

SIDE = 256


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="+", help="detectors beside fasterrcnn_small")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    detectors = [
        load_detector(name)
        for name in dict.fromkeys(["fasterrcnn_small", *options.names])
    ]
    image = torch.rand(1, SIDE, SIDE, 3)
    for detector in detectors:  # first calls make what later ones reuse
        once(detector, image)
    rounds = [
        [once(detector, image) for detector in detectors] for _ in range(options.rounds)
    ]
    lines = [
        (
            "| detector | forward, ms | forward + backward, ms | the latter, of"
            " fasterrcnn_small's | processor, ms |"
        ),
        "|---|---|---|---|---|",
    ]
    for number, detector in enumerate(detectors):
        forward, both, busy = (
            statistics.median(times[number][part] for times in rounds) * 1e3
            for part in (0, 1, 2)
        )
        ratio = statistics.median(times[number][1] / times[0][1] for times in rounds)
        lines.append(
            f"| {detector.name} | {forward:.0f} | {both:.0f} | {ratio:.2f} |"
            f" {busy:.0f} |"
        )
    sys.stdout.write("\n".join(lines) + "\n")


def runs() -> dict[str, Callable[[], object]]:
    """For `cpu_time.py`: the project's own detectors on a picture of a scene, and the
    gradient of an attack.
    """
    loaded = open_scene(Path(__file__).parents[1] / "scenes" / "car_street.xml")
    camera = next(iter(loaded.cameras.values()))
    camera = replace(camera, lens=replace(camera.lens, size=(SIDE, SIDE)))
    image = Renderer(loaded.settings)(loaded.scene, camera).clamp(0, 1)[None]

    def gradient(detector: Detector) -> torch.Tensor:
        leaf = image.clone().requires_grad_(True)
        scores = detector.candidates(leaf)[0].scores
        surest = scores.detach().amax(1).topk(5).indices  # of those near an object
        return torch.autograd.grad(scores[surest].sum(), leaf)[0]

    made: dict[str, Callable[[], object]] = {}
    for detector in map(load_detector, ("fasterrcnn_small", "yolov8n_small")):
        made[f"{detector.name}, detect"] = partial(detector.detect, image)
        made[f"{detector.name}, gradient"] = partial(gradient, detector)
    return made


def once(detector: Detector, image: torch.Tensor) -> tuple[float, float, float]:
    """Seconds of a forward pass, of one with its backward pass, and the processor's of
    the latter.
    """
    begun = time.perf_counter()
    detector.detect(image)
    forward = time.perf_counter() - begun
    begun = time.perf_counter()
    busy = time.process_time()
    leaf = image.clone().requires_grad_(True)
    (candidates,) = detector.candidates(leaf)
    torch.autograd.grad(candidates.scores.sum() + candidates.boxes.mean(), leaf)
    return forward, time.perf_counter() - begun, time.process_time() - busy


if __name__ == "__main__":
    main()
