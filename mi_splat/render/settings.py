"""What an image of a splat depends on besides the splat and the camera."""

import math
import numbers
from dataclasses import dataclass
from typing import Literal, get_args

from mi_splat.errors import InvalidValueError

Method = Literal["tile", "ray"]
"""How an image is made: "tile" as 3DGS does (`splat_tile`), "ray" by ray tracing
(`splat_ray`).
"""


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """What an image of a splat depends on besides the splat and the camera; the
    defaults are those of 3DGS.

    Attributes:
        method: "tile" projects Gaussians to the screen and sorts them by the depth of
            their means, as 3DGS does; "ray" meets each at its peak along the ray and
            sorts on every ray by itself.
        background: sRGB colour behind the splat.
        near: What is nearer than this (camera-space depth, world units) is culled:
            Gaussians by the depth of their mean with "tile", by that of their peak with
            "ray".
        colour_to_mean: For "ray": look a Gaussian's colour up in the direction of its
            mean, as "tile" always does, instead of along the ray.
        alpha: Append opacity (1 - transmittance) as a fourth channel.
        linear: Return linear values instead of sRGB.
        antialiased: For "tile": opacities take the 2D filter of Mip-Splatting (Yu et
            al. 2024) into account, as in the mode of gsplat of this name, so that small
            Gaussians do not swell. Off is the image of 3DGS.
        variant: Mitsuba variant, "llvm_ad_rgb" or "cuda_ad_rgb"; the current one (or
            LLVM) if empty.

    Raises:
        InvalidValueError: There is no such method, a number is not finite, `near` is
            not positive, the background has not three channels, or "ray" is combined
            with a filter on the screen.
    """

    method: Method = "tile"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near: float = 0.2
    colour_to_mean: bool = False
    alpha: bool = False
    linear: bool = False
    antialiased: bool = False
    variant: str = ""

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            expected = "one of " + ", ".join(get_args(Method))
            raise InvalidValueError.of(
                "method", expected, self.method, "choose one of them"
            )
        if not (
            isinstance(self.near, numbers.Real)
            and math.isfinite(self.near)
            and self.near > 0
        ):
            raise InvalidValueError.of(
                "near",
                "a positive distance",
                self.near,
                "pass world units, such as 0.2",
            )
        if len(self.background) != 3 or not all(map(math.isfinite, self.background)):
            raise InvalidValueError.of(
                "background",
                "three finite numbers",
                self.background,
                "pass an sRGB colour",
            )
        if self.antialiased and self.method == "ray":
            do = 'leave antialiased out, or use the method "tile"'
            raise InvalidValueError.of(
                "antialiased", 'the method "tile"', '"ray", which projects nothing', do
            )
