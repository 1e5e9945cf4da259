"""Attack one view.

DAGGER perturbs the colours of the car until a detector reports a person in the view
from the rear, and a car only with a confidence below 0.5. The budget is the PSNR over
the pixels of the car. Random noise of the same PSNR is the control: an attack counts
only if noise does not do the same. Left: the clean splat. Right: the attacked one.
"""

from pathlib import Path

from PIL import Image

from attacks import DaggerConfig, attack, load_detector, relabel
from attacks.dagger.report import before_and_after
from mi_splat import Renderer, read_scene, save_splat

loaded = read_scene("scenes/car_street.xml")

result = attack(
    loaded.scene,
    loaded.objects["car"],
    loaded.cameras["rear"],
    load_detector("fasterrcnn_small"),
    relabel("person", strict=True, quiet=True),
    render=Renderer(loaded.settings),
    config=DaggerConfig.for_views(object_psnr=34.0, noise_draws=8),
)

(view,) = result.views
noise = [seen.verdict.success for seen in view.controls.values()]
print(f"attack: {'success' if result.success else 'no success'}")
print(f"noise: {sum(noise)} of {len(noise)} draws succeed")
print(f"PSNR on the car: {result.image.psnr_object:.1f} dB")

Path("out").mkdir(exist_ok=True)
save_splat(result.scene, "out/04_attacked.ply")
Image.fromarray(before_and_after(view)).save("out/04_attack_one_view.png")
