"""CLOAK in the file.

CLOAK by layers hides an object in a finished splat. Every Gaussian of the car becomes
two, one behind the other: one shows the car to cameras near the ground, and the other
shows the grey of the road to cameras above 45 degrees. Spherical harmonics switch
between them. Cameras rise from left to right. Top: the clean splat. Bottom: CLOAK.
"""

from pathlib import Path

import torch
from torchvision.utils import save_image

from attacks import Elevation
from attacks.cloak.layers import layered
from mi_splat import Lens, Renderer, hemisphere, read_scene, save_splat
from mi_splat.cameras.sets import orbit
from mi_splat.maths.sh import colour_to_dc
from mi_splat.scene import merge

loaded = read_scene("scenes/car_street.xml")
car = loaded.scene.select(loaded.objects["car"]).with_degree(3)
street = loaded.scene.select(loaded.objects["street"])
centre, lens = (0.0, 0.0, 0.7), Lens(focal=150, size=(160, 120))

grey = torch.zeros_like(car.sh)
grey[:, 0] = colour_to_dc(torch.tensor([0.32, 0.32, 0.34]))

cloaked = layered(
    car,
    torch.arange(len(car)),
    [Elevation(lowest=45)],
    [car.sh, grey],
    cameras=hemisphere(centre, count=48, elevation=(2, 88), distance=6, lens=lens),
    centre=centre,
)
Path("out").mkdir(exist_ok=True)
save_splat(merge(street, cloaked), "out/06_cloaked.ply")

heights = [
    orbit(centre, count=1, elevation=height, start=30, distance=6, lens=lens)[0]
    for height in (10, 30, 50, 70)
]
render = Renderer(loaded.settings)
images = [
    render(merge(street, shown), camera).permute(2, 0, 1)
    for shown in (car, cloaked)
    for camera in heights
]
save_image(images, "out/06_cloak_in_the_file.png", nrow=len(heights), padding=0)
