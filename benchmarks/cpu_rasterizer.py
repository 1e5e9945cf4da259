"""How fast is `Renderer` beside a scalar CPU rasteriser of 3DGS?

CPU time of one thread, as ratios.

    python benchmarks/cpu_rasterizer.py [--rounds 9] [--large] [--json]

The peer is `cpu_rasterizer.c`, compiled here by `cc -O3 -march=native`. Only its loops
over pixels are timed, not its projection (in PyTorch, below), its sort or the copy of
its gradients, so each ratio is a lower bound; ours are whole calls, from torch to
torch. It runs twice: over the square around the longer axis of each ellipse, as
published, and over the tight box of alpha >= 1/255, which no published code has. Before
anything is timed, its images and gradients by all five tensors are held to ours.
"""

import argparse
import ctypes
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from cpu_time import interleaved, one_thread, ratio
from render import SETTINGS, camera_of, shell, through_renderer

from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras.camera import Camera
from mi_splat.maths.sh import sh_to_colour
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene

IMAGE_ERROR = 1e-4
GRADIENT_ERROR = 5e-3
"""Largest length of a difference from ours, relative to the length of ours: rounding
moves some alphas over 1/255.
"""

Floats = NDArray[np.float32]
NUMBERS = 9
SPLAT = 13
"""Floats of a `Gradient`, and 32-bit words of a `Splat`."""


def compiled(folder: Path) -> ctypes.CDLL:
    """The peer as a library."""
    source = Path(__file__).with_suffix(".c")
    library = folder / "cpu_rasterizer.so"
    flags = ["-O3", "-march=native", "-shared", "-fPIC", "-lm"]
    subprocess.run(["cc", str(source), "-o", str(library), *flags], check=True)
    return ctypes.CDLL(str(library))


def project(
    scene: GaussianScene, camera: Camera, *, tight: bool
) -> tuple[Tensor, NDArray[np.int32]]:
    """(M, 9) numbers on the screen of what is visible, from near to far, and boxes of
    pixels (M, 4).
    """
    pose = camera.to_camera.float()
    rotation = pose[:3, :3]
    position = camera.position.float()
    local = scene.means @ rotation.T + pose[:3, 3]
    rows = local[:, 2].argsort(stable=True)
    rows = rows[local[rows, 2] >= 0.2]
    local = local[rows]
    q = torch.nn.functional.normalize(scene.rotations[rows], dim=1)
    w, x, y, z = q.unbind(1)
    axes = torch.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1
    ).reshape(-1, 3, 3)  # fmt: skip
    depth = local[:, 2]
    focal = torch.tensor([camera.fx, camera.fy])
    tangent = local[:, :2] / depth[:, None]
    guard = (
        1.3 * 0.5 * torch.tensor([camera.width / camera.fx, camera.height / camera.fy])
    )
    clamped = torch.minimum(torch.maximum(tangent, -guard), guard)
    jacobian = torch.cat(
        [torch.eye(2).expand(len(rows), 2, 2), -clamped[..., None]], dim=2
    )
    factor = (
        (focal / depth[:, None])[..., None]
        * jacobian
        @ rotation
        @ (axes * scene.scales[rows, None])
    )
    covariance = factor @ factor.mT + 0.3 * torch.eye(2)
    a, b, c = (covariance.inverse()[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    centre = tangent * focal + torch.tensor([camera.cx, camera.cy])
    towards = torch.nn.functional.normalize(scene.means[rows] - position, dim=1)
    colour = sh_to_colour(scene.sh[rows], towards).clamp(min=0)
    opacity = scene.opacities[rows]
    variances = covariance.diagonal(dim1=1, dim2=2)
    if not tight:
        half = variances.mean(1)
        variances = (half + (half**2 - covariance.det()).clamp(min=0).sqrt())[
            :, None
        ].expand(-1, 2)
    reach = (2 * (255 * opacity).log()).clamp(min=0)[:, None] * variances
    size = torch.tensor([camera.width, camera.height])
    low = (centre - reach.sqrt() - 0.5).floor().clamp(min=0).minimum(size)
    high = (centre + reach.sqrt() + 0.5).ceil().clamp(min=0).minimum(size)
    box = (
        torch.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], dim=1)
        .detach()
        .int()
        .numpy()
    )
    return torch.stack([*centre.T, a, b, c, opacity, *colour.T], dim=1), box


class Peer:
    """The C loops for one scene and camera in front of black."""

    def __init__(
        self,
        library: ctypes.CDLL,
        scene: GaussianScene,
        camera: Camera,
        grad_image: Tensor,
        *,
        tight: bool,
    ) -> None:
        self.leaves = [
            tensor.clone().requires_grad_(True) for tensor in scene.tensors()
        ]
        self.numbers, box = project(
            GaussianScene.unchecked(*self.leaves), camera, tight=tight
        )
        self.splats = np.empty((len(box), SPLAT), np.float32)
        self.splats[:, :NUMBERS] = self.numbers.detach().numpy()
        self.splats[:, NUMBERS:] = box.view(np.float32)
        self.image = np.empty((camera.height, camera.width, 3), np.float32)
        self.transmittance = np.empty(self.image.shape[:2], np.float32)
        self.last = np.empty(self.image.shape[:2], np.int32)
        self.grad_image, self.background = grad_image.numpy(), np.zeros(3, np.float32)
        self.gradients = np.zeros((len(box), NUMBERS), np.float32)
        self.library = library
        self.size = (camera.width, camera.height)

    def forward(self) -> None:
        """Make the image."""
        outputs = map(
            _pointer, (self.background, self.image, self.transmittance, self.last)
        )
        self.library.forward(
            len(self.splats), _pointer(self.splats), *self.size, *outputs
        )

    def both(self) -> None:
        """Make the image and its gradient."""
        self.forward()
        self.gradients[:] = 0
        inputs = map(
            _pointer,
            (
                self.background,
                self.grad_image,
                self.transmittance,
                self.last,
                self.gradients,
            ),
        )
        self.library.backward(_pointer(self.splats), *self.size, *inputs)

    def check(self, scene: GaussianScene, camera: Camera) -> dict[str, float]:
        """Differences from ours; refuses large ones."""
        self.both()
        self.numbers.backward(torch.from_numpy(self.gradients))  # type: ignore[no-untyped-call]
        ours = [tensor.clone().requires_grad_(True) for tensor in scene.tensors()]
        image = Renderer()(GaussianScene(*ours), camera)
        image.backward(torch.from_numpy(self.grad_image))  # type: ignore[no-untyped-call]
        pairs: dict[str, tuple[Tensor | None, Tensor | None]] = {
            "image": (image.detach(), torch.from_numpy(self.image)),
            **{
                name: (a.grad, b.grad)
                for name, a, b in zip(ATTRIBUTES, ours, self.leaves, strict=True)
            },
        }
        errors: dict[str, float] = {}
        for name, (mine, theirs) in pairs.items():
            assert mine is not None
            assert theirs is not None
            errors[name] = error = float((mine - theirs).norm() / mine.norm())
            if not error <= (IMAGE_ERROR if name == "image" else GRADIENT_ERROR):
                raise SystemExit(f"{name}: the peer differs from ours by {error:.2g}")
        return errors


def _pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def measure(library: ctypes.CDLL, count: int, size: int, rounds: int) -> dict[str, Any]:
    """Differences, median times in ms, and how many times as long the peer takes."""
    scene = shell(count)
    camera = camera_of(size)
    grad_image = torch.randn(size, size, 3, generator=torch.Generator().manual_seed(1))
    square, tight = (
        Peer(library, scene, camera, grad_image, tight=which) for which in (False, True)
    )
    differences = [peer.check(scene, camera) for peer in (square, tight)]
    row: dict[str, Any] = {
        "gaussians": count,
        "size": size,
        "differences": differences[0],
    }
    forward, both = through_renderer(scene, camera)
    runs: dict[str, Callable[[], None]] = {
        **{
            "ours forward": forward,
            "square forward": square.forward,
            "tight forward": tight.forward,
        },
        **{"ours both": both, "square both": square.both, "tight both": tight.both},
    }
    times = interleaved(runs, rounds=rounds)
    for label in ("forward", "both"):
        names = [f"{who} {label}" for who in ("ours", "square", "tight")]
        row[label] = {
            f"{name.split()[0]}_ms": round(1e3 * statistics.median(times[name]), 2)
            for name in names
        }
        row[label] |= {
            f"{name.split()[0]}_to_ours": round(ratio(times[name], times[names[0]]), 1)
            for name in names[1:]
        }
    return row


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--rounds", type=int, default=9, help="interleaved runs of everything"
    )
    parser.add_argument(
        "--large", action="store_true", help="one million Gaussians at 640, too"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    options = parser.parse_args()
    one_thread()
    variant.use()
    with tempfile.TemporaryDirectory() as folder:
        library = compiled(Path(folder))
        settings = (*SETTINGS, *([(1_000_000, 640)] if options.large else []))
        rows = [
            measure(library, count, size, options.rounds) for count, size in settings
        ]
    if options.json:
        sys.stdout.write(json.dumps(rows, indent=2) + "\n")
        return
    for row in rows:
        for label in ("forward", "both"):
            cells = "   ".join(
                f"{key.replace('_', ' ')} {value:,.1f}"
                for key, value in row[label].items()
            )
            sys.stdout.write(
                f"{row['gaussians']:>9,} at {row['size']}: {label:<8} {cells}\n"
            )
        differences = ", ".join(
            f"{name} {error:.1e}" for name, error in row["differences"].items()
        )
        sys.stdout.write(f"{'':>17}differences: {differences}\n")


if __name__ == "__main__":
    main()
