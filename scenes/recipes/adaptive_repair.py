"""Measures what a median of neighbours leaves of DAGGER, with an attacker who knows it.

    python -m scenes.recipes.adaptive_repair --out out/repair.json

Two attackers at each camera of the synthetic car: one who does not know of the repair,
and one who differentiates through it. Each file is judged as it is delivered and as it
is repaired, and counts where the detector reports the clean object as what it is under
the same condition.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from attacks import DaggerConfig, attack, load_detector, relabel
from attacks.detectors.base import Detector
from attacks.detectors.registry import operating_threshold
from attacks.objectives.base import confidence
from attacks.observe.repairs import with_itself, with_medians
from attacks.observe.views import as_saved, object_boxes
from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.cli.console import show
from mi_splat.io.documents import save_json
from mi_splat.io.images import quantise
from mi_splat.maths.metrics import psnr
from mi_splat.render.renderer import Renderer
from mi_splat.render.scene_files import read_scene
from mi_splat.scene import GaussianScene

SCENE = Path("scenes/car_street.xml")
OBJECT = "car"
TARGET = "person"
DETECTOR = "yolov8n_small"
NEIGHBOURS = 8
OBJECT_PSNR = 32.0


def repairing(clean: GaussianScene, render: RenderFn) -> RenderFn:
    """A renderer of repaired splats; neighbours are those of the clean one."""
    rows = with_itself(clean.means, NEIGHBOURS)

    def repaired(scene: GaussianScene, camera: Camera) -> Tensor:
        return render(with_medians(scene, rows), camera)

    return repaired


def reported(
    detector: Detector, image: Tensor, box: Tensor, labels: tuple[str, ...]
) -> list[float]:
    """Confidence in each class on the object."""
    (detections,) = detector.detect(quantise(image.clamp(0, 1))[None])
    return [confidence(detections, box, labels=[label]) for label in labels]


def decibels(one: Tensor, other: Tensor) -> float | None:
    """PSNR of two images; None where they are the same."""
    value = float(psnr(one, other))
    return value if math.isfinite(value) else None


def measured(seed: int) -> Iterator[dict[str, Any]]:
    """What each attacker reaches at each camera."""
    loaded = read_scene(SCENE)
    rows = loaded.objects[OBJECT]
    detector = load_detector(DETECTOR)
    least = operating_threshold(detector)
    plain = Renderer(loaded.settings)
    renderers = {"delivered": plain, "repaired": repairing(loaded.scene, plain)}
    attackers = {"knows nothing": plain, "differentiates it": renderers["repaired"]}
    config = DaggerConfig.for_views(
        object_psnr=OBJECT_PSNR, seed=seed, random_start=seed > 0, noise_draws=0
    )
    for name, camera in loaded.cameras.items():
        (box,) = object_boxes(loaded.scene, rows, camera, render=plain)
        if box is None:
            continue
        for attacker, render in attackers.items():
            result = attack(
                loaded.scene,
                rows,
                camera,
                detector,
                relabel(TARGET, strict=True, quiet=True),
                render=render,
                config=config,
            )
            saved = as_saved(result.scene)
            for judge, shown in renderers.items():
                with torch.no_grad():
                    clean = shown(loaded.scene, camera)
                    attacked = shown(saved, camera)
                (own,) = reported(detector, clean, box, (OBJECT,))
                left, wanted = reported(detector, attacked, box, (OBJECT, TARGET))
                yield {
                    "camera": name,
                    "attacker": attacker,
                    "judged": judge,
                    "clean detected": own >= least,
                    "replaced": wanted >= least and left < least,
                    "price": decibels(plain(loaded.scene, camera), clean),
                    "psnr": decibels(clean, attacked),
                }


def main() -> None:
    """Measure, print what was counted, and write every row."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/repair.json"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    options = parser.parse_args()
    rows = [{"seed": seed, **row} for seed in options.seeds for row in measured(seed)]
    for attacker in dict.fromkeys(row["attacker"] for row in rows):
        for judge in dict.fromkeys(row["judged"] for row in rows):
            seen = [
                row
                for row in rows
                if row["attacker"] == attacker and row["judged"] == judge
            ]
            counted = [row for row in seen if row["clean detected"]]
            replaced = sum(row["replaced"] for row in counted)
            show(f"{attacker}, {judge}: {replaced} of {len(counted)}")
    prices = sorted({row["price"] for row in rows if row["price"] is not None})
    show(f"price: {', '.join(f'{price:.1f}' for price in prices)} dB")
    save_json({"rows": rows}, options.out)


if __name__ == "__main__":
    main()
