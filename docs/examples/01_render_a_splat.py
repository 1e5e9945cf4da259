"""Render a splat with `mi.render`.

A Mitsuba scene holds a splat as `<shape type="gaussians">`, from any [file
format](../formats.md). The integrator `splat_tile` makes the image that 3DGS trainers
optimise. Its pixels are sRGB values, so they are written without another conversion.
"""

from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

import mi_splat.render.plugins  # noqa: F401, registers `gaussians` and the integrators

mi.set_variant("llvm_ad_rgb")

XML = """
<scene version="3.0.0">
    <integrator type="splat_tile">
        <rgb name="background" value="0.55, 0.72, 0.9"/>
    </integrator>
    <shape type="gaussians" id="street">
        <string name="filename" value="scenes/car_street_street.ply"/>
    </shape>
    <shape type="gaussians" id="car">
        <string name="filename" value="scenes/car_street_car.ply"/>
    </shape>
    <sensor type="perspective">
        <float name="fov" value="36"/>
        <transform name="to_world">
            <lookat origin="7.6, -4, 2.6" target="0, 0, 0.8" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="512"/>
            <integer name="height" value="288"/>
        </film>
    </sensor>
</scene>
"""

scene = mi.load_string(XML)
image = np.array(mi.render(scene))

out = Path("out")
out.mkdir(exist_ok=True)
Image.fromarray((255 * image.clip(0, 1)).round().astype("uint8")).save(
    out / "01_render_a_splat.png"
)
