"""Train from images.

`fit` is the training recipe of 3DGS. A splat of a car is rendered from 64
cameras, and another splat is trained from 60 of these images, starting from a sixth of
the points of the first, in grey. The other four views measure the result. Top: held-out
views. Bottom: the same views of the trained splat.
"""

from pathlib import Path

import torch
from torchvision.utils import save_image

from mi_splat import (
    FitConfig,
    Lens,
    Renderer,
    RenderSettings,
    View,
    fit,
    from_points,
    hemisphere,
    load_splat,
)
from mi_splat.maths.metrics import psnr
from mi_splat.training.strategies import FixedConfig

car = load_splat("scenes/car_street_car.ply")
render = Renderer(RenderSettings(background=(0.93, 0.93, 0.93)))
cameras = hemisphere(
    (0.0, 0.0, 0.7),
    count=64,
    elevation=(5, 80),
    distance=6,
    lens=Lens(focal=120, size=(120, 96)),
)
views = [View(camera, render(car, camera).clamp(0, 1)) for camera in cameras]
held_out = views[8::16]
training = [view for view in views if view not in held_out]

points = car.means[::6]
start = from_points(points, torch.full_like(points, 0.5), opacity=0.5)
config = FitConfig(iterations=400, sh_degree=1, strategy=FixedConfig())
trained = fit(training, start, render=render, config=config)

images = [render(trained.scene, view.camera).clamp(0, 1) for view in held_out]
for view, image in zip(held_out, images, strict=True):
    print(f"{psnr(image, view.image):.1f} dB")

rows = [view.image for view in held_out] + images
Path("out").mkdir(exist_ok=True)
save_image(
    torch.stack(rows).detach().permute(0, 3, 1, 2),
    "out/08_train_from_images.png",
    nrow=len(held_out),
    padding=0,
)
