"""Evaluate over views and conditions.

An attack that succeeds in one image may fail in the next. Here an attacked splat (run
[example 4](04_attack_one_view.py) first) is evaluated from all six cameras of its
scene, although only the rear view was attacked, and under conditions that change the
image, the file format or the camera. A condition is itself a renderer, which `evaluate`
takes. The images show the rear view: as attacked, after JPEG compression, after
SPZ compression of the splat, and from ten degrees farther around the car.
"""

from pathlib import Path

import numpy as np
from PIL import Image

from attacks import evaluate, load_detector
from attacks.observe.conditions import Viewing, condition_of
from attacks.observe.drawing import annotated
from mi_splat import load_splat, read_scene

loaded = read_scene("scenes/car_street.xml")
car = loaded.objects["car"]
viewing = Viewing(
    settings=loaded.settings,
    centre=(0.0, 0.0, 0.7),
    alone=lambda scene: scene.select(car),
)
splats = {
    "clean": loaded.scene.with_degree(3),
    "attacked": load_splat("out/04_attacked.ply"),
}
cameras = list(loaded.cameras.values())
rear = list(loaded.cameras).index("rear")

images = []
for name in ("", "JPEG 75", ".spz", "10 degrees"):
    evaluated = evaluate(
        splats,
        car,
        cameras,
        load_detector("fasterrcnn_small"),
        render=condition_of(name, viewing),
        target="person",
    )
    title = name or "as attacked"
    rate = evaluated.rates["fasterrcnn_small"]["target_attacked"]
    print(f"{title}: person in {rate.successes} of {rate.total} views")
    seen = evaluated.views["attacked"][rear]
    images.append(annotated(seen.image, seen.detections, title))

Path("out").mkdir(exist_ok=True)
Image.fromarray(np.concatenate(images, axis=1)).save("out/05_views_and_conditions.png")
