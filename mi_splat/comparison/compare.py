"""One splat through several methods: their images, and each two of them beside each
other.
"""

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.comparison.methods import Method
from mi_splat.errors import InvalidValueError, listed
from mi_splat.fields import Checked, Count, Seed
from mi_splat.io.documents import file_name, save_png
from mi_splat.io.images import quantise, to_bytes
from mi_splat.io.labels import write_label
from mi_splat.maths.metrics import mse, ssim
from mi_splat.scene import GaussianScene

WIDTH = 256
"""Pixels that an image is wide on a sheet, at least."""
GAP = 4
AMPLIFY = 8.0
"""Factor of the differences in a sheet."""
PICTURES = "pictures"
"""Folder that has a folder for each method, whose images can be compared again."""


def sheet(pictures: Mapping[str, Tensor], *, factor: float) -> NDArray[np.uint8]:
    """The images of one camera: the methods, and after them the absolute differences
    of each two.
    """
    tiles = [_labelled(to_bytes(picture), name) for name, picture in pictures.items()]
    for (first_name, first), (second_name, second) in combinations(pictures.items(), 2):
        gap = (first.clamp(0, 1) - second.clamp(0, 1)).abs()
        tiles.append(
            _labelled(
                to_bytes(factor * gap), f"|{first_name} - {second_name}| x {factor:g}"
            )
        )
    columns = max(3, len(pictures))  # of two, the difference stands beside them
    height, width = tiles[0].shape[:2]
    rows = -(-len(tiles) // columns)
    canvas = np.full(
        (rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8
    )
    for number, tile in enumerate(tiles):
        y = number // columns * (height + GAP)
        x = number % columns * (width + GAP)
        canvas[y : y + height, x : x + width] = tile
    return canvas


def _labelled(pixels: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """An image, large enough for its label, with the label."""
    factor = max(1, -(-WIDTH // pixels.shape[1]))
    picture = Image.fromarray(pixels)
    picture = picture.resize(
        (picture.width * factor, picture.height * factor), Image.Resampling.NEAREST
    )
    write_label(ImageDraw.Draw(picture), (4, 4), text, "#000000", size=14)
    return np.asarray(picture)


def save_sheets(
    pictures: Mapping[str, Mapping[str, Tensor]], folder: Path
) -> list[Path]:
    """Write a sheet for each camera, and each image on its own."""
    sheets = []
    for view, seen in pictures.items():
        sheets.append(folder / f"{file_name(view)}.png")
        save_png(sheet(seen, factor=AMPLIFY), sheets[-1])
        for name, picture in seen.items():
            pictures_folder = folder / PICTURES / file_name(name)
            pictures_folder.mkdir(parents=True, exist_ok=True)
            save_png(to_bytes(picture), pictures_folder / f"{file_name(view)}.png")
    return sheets


LEAST_SSIM = 11
"""Pixels that the shorter side of an image needs for it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureDistance:
    """How far apart two images are, clipped to [0, 1]; None is what was not
    measured.
    """

    pixels: int
    mse: float
    ssim: float | None

    @property
    def psnr(self) -> float | None:
        """DB; None for equal images, whose PSNR is infinite."""
        if self.mse == 0:
            return None
        return -10 * math.log10(self.mse)


def picture_distance(first: Tensor, second: Tensor) -> PictureDistance:
    """Compare two images."""
    first, second = (picture.detach().clamp(0, 1) for picture in (first, second))
    return PictureDistance(
        pixels=first.shape[0] * first.shape[1],
        mse=float(mse(first.double(), second.double())),
        ssim=float(ssim(first, second)) if min(first.shape[:2]) >= LEAST_SSIM else None,
    )


def pooled(distances: Sequence[PictureDistance]) -> PictureDistance:
    """Several images as one: the squared error of all their pixels, and the mean
    SSIM, if all have one.
    """
    known = [d.ssim for d in distances if d.ssim is not None]
    pixels = sum(d.pixels for d in distances)
    return PictureDistance(
        pixels=pixels,
        mse=sum(distance.mse * distance.pixels for distance in distances) / pixels,
        ssim=(
            sum(known) / len(known) if known and len(known) == len(distances) else None
        ),
    )


def weighting(camera: Camera, seed: int) -> Tensor:
    """(H, W, 3) fixed random weights, normally distributed; with them an image becomes
    one number.
    """
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(camera.height, camera.width, 3, generator=generator)


def gradients(
    render: RenderFn, scene: GaussianScene, camera: Camera, weights: Tensor
) -> dict[str, Tensor]:
    """The gradient of a weighted sum of an image's values with respect to each
    attribute.

    A quaternion's length means nothing, and renderers differ in whether they divide by
    it. So of the gradient of rotations the part along the quaternion is taken out.
    """
    leaves = [
        tensor.detach().clone().requires_grad_(True) for tensor in scene.tensors()
    ]
    picture = render(GaussianScene(*leaves), camera)
    (picture * weights.to(picture.device)).sum().backward()  # type: ignore[no-untyped-call]
    pairs = zip(ATTRIBUTES, leaves, strict=True)
    by_attribute: dict[str, Tensor] = {
        name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        for name, leaf in pairs
    }
    along = (by_attribute["rotations"] * scene.rotations).sum(-1, keepdim=True)
    return {
        **by_attribute,
        "rotations": by_attribute["rotations"] - along * scene.rotations,
    }


class GradientAgreement:
    """How well two gradients of one attribute agree, over all cameras that were
    added.
    """

    def __init__(self) -> None:
        # first . second, and squares of both and of the difference
        self._sums = torch.zeros(4, dtype=torch.float64)

    def add(self, first: Tensor, second: Tensor) -> None:
        """Take in the gradients, (N, ...) each, of one more image."""
        x, y = (
            gradient.detach().cpu().double().flatten() for gradient in (first, second)
        )
        self._sums += torch.stack([x @ y, x @ x, y @ y, (x - y) @ (x - y)])

    @property
    def cosine(self) -> float | None:
        """Cosine of the angle between them, 1 if they point the same way; None if one
        is 0 or not finite.
        """
        product, first, second, _ = self._sums.tolist()
        lengths = math.sqrt(first * second)
        if not (lengths > 0 and math.isfinite(lengths)):
            return None
        cosine: float = product / lengths
        return max(-1.0, min(1.0, cosine))

    @property
    def relative_error(self) -> float | None:
        """Length of the difference over the length of the first; None if that is 0, or
        something is not finite.
        """
        _, first, _, gap = self._sums.tolist()
        if first > 0 and math.isfinite(first) and math.isfinite(gap):
            return math.sqrt(gap / first)
        return None


FORWARD = "picture"
GRADIENT = "picture_and_gradient"
"""Kinds of calls whose cost is measured."""
Agreement = dict[str, GradientAgreement]
"""Of two methods, by attribute."""
Cost = dict[str, Any]
"""Processor seconds of all threads: the median, those of each round, and the median
ratio to the first method.
"""
Run = Callable[[], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareConfig(Checked):
    """What is measured.

    Raises:
        InvalidValueError: A number is not whole, or less than 0.
    """

    gradients: bool = True
    """Whether gradients are compared, for methods that have them. --no-gradients: do
    not compare gradients.
    """
    rounds: Count = 5
    """How often each method is timed; 0 measures no time."""
    seed: Seed = 0
    """Seed of the random weights that make one number of an image, whose gradients are
    compared.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two methods: the distances of their images by camera, with so many bits a
    channel, and of their gradients.
    """

    bits: int
    distances: dict[str, PictureDistance]
    agreement: Agreement | None

    @property
    def whole(self) -> PictureDistance:
        """All cameras as one."""
        return pooled(list(self.distances.values()))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Comparison:
    """Images by camera and method, each two methods, and costs."""

    pictures: dict[str, dict[str, Tensor]]
    pairs: dict[tuple[str, str], Pair]
    costs: dict[str, dict[str, Cost]]

    def __repr__(self) -> str:
        pairs = (
            f"{a} and {b} {pair.whole.psnr or math.inf:.1f} dB"
            for (a, b), pair in self.pairs.items()
        )
        return f"Comparison({len(self.pictures)} cameras, PSNR: {listed(pairs)})"


def compare(
    scene: GaussianScene,
    cameras: Mapping[str, Camera],
    methods: Mapping[str, Method],
    *,
    config: CompareConfig | None = None,
    on_step: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Render every camera with every method, and measure how images, gradients and
    times differ.
    """
    config = config or CompareConfig()
    for what, given, least in (("cameras", cameras, 1), ("methods", methods, 2)):
        if len(given) < least:
            raise InvalidValueError.of(
                what, f"{least} or more", len(given), "name more"
            )
    pictures: dict[str, dict[str, Tensor]] = {}
    for view, camera in cameras.items():
        pictures[view] = {}
        for name, method in methods.items():
            on_step(f"{name} from {view}")
            pictures[view][name] = _picture(name, method, scene, camera)
    if config.gradients:
        agreement = _agreement(scene, cameras, methods, config, on_step)
    else:
        agreement = {}
    pairs = {}
    for names in combinations(methods, 2):
        bits = min(methods[name].bits for name in names)
        distances = {
            view: picture_distance(
                *(quantise(seen[name]) if bits == 8 else seen[name] for name in names)
            )
            for view, seen in pictures.items()
        }
        pairs[names] = Pair(
            bits=bits, distances=distances, agreement=agreement.get(names)
        )
    if config.rounds:
        costs = _costs(scene, next(iter(cameras.values())), methods, config, on_step)
    else:
        costs = {}
    return Comparison(pictures=pictures, pairs=pairs, costs=costs)


def _picture(name: str, method: Method, scene: GaussianScene, camera: Camera) -> Tensor:
    """An image of a method, checked, on the CPU."""
    with torch.no_grad():
        picture = method.render(scene, camera).cpu()
    expected = (camera.height, camera.width, 3)
    if tuple(picture.shape) != expected or not bool(picture.isfinite().all()):
        got = (
            f"{tuple(picture.shape)}, {int((~picture.isfinite()).sum())} values not"
            " finite"
        )
        do = "mend the method, or leave it out"
        raise InvalidValueError.of(
            f"image of {name}", f"{expected} finite values", got, do
        )
    return picture


def _agreement(
    scene: GaussianScene,
    cameras: Mapping[str, Camera],
    methods: Mapping[str, Method],
    config: CompareConfig,
    on_step: Callable[[str], None],
) -> dict[tuple[str, str], Agreement]:
    differentiable = [name for name, method in methods.items() if method.differentiable]
    agreements: dict[tuple[str, str], Agreement] = {
        names: {attribute: GradientAgreement() for attribute in ATTRIBUTES}
        for names in combinations(differentiable, 2)
    }
    for number, (view, camera) in enumerate(cameras.items() if agreements else ()):
        weights = weighting(camera, config.seed + number)
        each = {}
        for name in differentiable:
            on_step(f"{name} from {view}: gradient")
            each[name] = gradients(methods[name].render, scene, camera, weights)
        for (first, second), by_attribute in agreements.items():
            for attribute, agreement in by_attribute.items():
                agreement.add(each[first][attribute], each[second][attribute])
    return agreements


def _costs(
    scene: GaussianScene,
    camera: Camera,
    methods: Mapping[str, Method],
    config: CompareConfig,
    on_step: Callable[[str], None],
) -> dict[str, dict[str, Cost]]:
    weights = weighting(camera, config.seed)

    def forward(method: Method) -> None:
        with torch.no_grad():
            method.render(scene, camera).sum().item()  # so that a device has finished

    def both(method: Method) -> None:
        gradients(method.render, scene, camera, weights)["sh"].sum().item()

    rendering = {name: method for name, method in methods.items() if method.renders}
    runs: dict[str, dict[str, Run]] = {
        FORWARD: {name: partial(forward, method) for name, method in rendering.items()}
    }
    if config.gradients:
        runs[GRADIENT] = {
            name: partial(both, method)
            for name, method in rendering.items()
            if method.differentiable
        }
    return {
        kind: costs_of(
            timed,
            rounds=config.rounds,
            on_step=lambda text, kind=kind: on_step(f"{text} ({kind})"),  # type: ignore[misc]
        )
        for kind, timed in runs.items()
        if timed
    }


def costs_of(
    runs: Mapping[str, Run], *, rounds: int, on_step: Callable[[str], None]
) -> dict[str, Cost]:
    """The cost of each method.

    In each round all take their turn, since a machine that others use changes its speed
    within minutes.
    """
    seconds = {name: list[float]() for name in runs}
    for run in runs.values():  # whatever is compiled is compiled now
        run()
    for number in range(1, rounds + 1):
        for name, run in runs.items():
            on_step(f"{name}: time, round {number} of {rounds}")
            begun = time.process_time()
            run()
            seconds[name].append(time.process_time() - begun)
    first = next(iter(seconds.values()), [])
    return {
        name: {
            "seconds": statistics.median(times),
            "rounds": times,
            "ratio": statistics.median(
                time / base for time, base in zip(times, first, strict=True)
            ),
        }
        for name, times in seconds.items()
    }


def as_dict(comparison: Comparison, methods: Mapping[str, Method]) -> dict[str, Any]:
    """What was measured, as JSON can hold it; a figure that was not measured is
    null.
    """
    return {
        "methods": {
            name: {
                "differentiable": method.differentiable,
                "bits": method.bits,
                **{
                    kind: comparison.costs.get(kind, {}).get(name)
                    for kind in (FORWARD, GRADIENT)
                },
            }
            for name, method in methods.items()
        },
        "pairs": [
            {
                "methods": list(names),
                "bits": pair.bits,
                **_figures(pair.whole),
                "by_camera": {
                    view: _figures(distance)
                    for view, distance in pair.distances.items()
                },
                "gradients": (
                    pair.agreement
                    and {
                        name: {
                            "cosine": each.cosine,
                            "relative_error": each.relative_error,
                        }
                        for name, each in pair.agreement.items()
                    }
                ),
            }
            for names, pair in comparison.pairs.items()
        ],
    }


def _figures(distance: PictureDistance) -> dict[str, float | None]:
    return {"psnr": distance.psnr, "mse": distance.mse, "ssim": distance.ssim}
