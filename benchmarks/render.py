"""How fast are `splat_tile` and `splat_ray`?

Side by side with Mitsuba's own `volprim_rf_basic`, as ratios.

    python benchmarks/render.py [--rounds 15] [--cpu] [--json]
    # ours alone, beside older code
    python benchmarks/cpu_time.py benchmarks/render.py --against REVISION

The same splat, camera and process for both; each is run three times before it is timed,
so that compilation stays apart, and the runs are interleaved, since a shared machine
changes its speed within minutes. Reported is the median over the rounds of the ratio
within a round. `volprim_rf_basic` takes one sample a pixel through a box filter;
backward means the gradient of a random linear function of the image with respect to
every parameter of the splat. `splat_ray` takes one sample a pixel, too, through the
same random points of pixels. Its tree is built before, as the one of `volprim_rf_basic`
is, and not in the times.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from cpu_time import Clock, add_cpu_flag, clock, interleaved, ratio

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.render import variant
from mi_splat.scene import GaussianScene

SETTINGS = ((10_000, 256), (100_000, 256), (100_000, 640))
Runs = tuple[Callable[[], None], Callable[[], None]]


def shell(count: int, *, seed: int = 0) -> GaussianScene:
    """`count` Gaussians of SH degree 3 on a noisy unit sphere, about as large as their
    distance from each other.

    In torch's own memory: NumPy's may not be aligned as Dr.Jit wants it, and is then
    copied for every image.
    """
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3))
    means = (
        means / np.linalg.norm(means, axis=1, keepdims=True)
        + rng.normal(size=(count, 3)) * 0.02
    )
    scales = np.exp(rng.normal(size=(count, 3)) * 0.3) * 1.2 / np.sqrt(count)
    rotations = rng.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    opacities = rng.uniform(0.1, 1.0, count)
    sh = rng.normal(size=(count, 16, 3)) * 0.2
    return GaussianScene(
        *(
            torch.tensor(a, dtype=torch.float32)
            for a in (means, scales, rotations, opacities, sh)
        )
    )


def through_mitsuba(scene: GaussianScene, camera: Camera, integrator: str) -> Runs:
    """Forward, and forward + backward, by `mi.render`."""
    import drjit as dr
    import mitsuba as mi

    from mi_splat.render.plugins.sensor import sensor_dict
    from mi_splat.render.plugins.shape import ellipsoid_arrays

    shape = {"type": "ellipsoids", "id": "splat", **ellipsoid_arrays(scene)}
    parts = {
        "integrator": {"type": integrator},
        "splat": shape,
        "sensor": sensor_dict(camera),
    }
    loaded = mi.load_dict({"type": "scene", **parts})
    params = mi.traverse(loaded)
    keys = [f"splat.{name}" for name in ("data", "opacities", "sh_coeffs")]
    rng = np.random.default_rng(1)
    # splat_tile keeps its last images for their gradients; a timed forward pass must
    # not find one.
    caches = integrator == "splat_tile"
    clear_cache = loaded.integrator().clear_cache if caches else lambda: None
    weights = mi.TensorXf(
        rng.normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    )

    def forward() -> None:
        clear_cache()
        dr.eval(mi.render(loaded, spp=1))
        dr.sync_thread()

    def both() -> None:
        clear_cache()
        for key in keys:
            dr.disable_grad(params[key])
            dr.enable_grad(params[key])
        dr.backward(dr.sum(mi.render(loaded, params, spp=1, spp_grad=1) * weights))
        dr.eval([dr.grad(params[key]) for key in keys])
        dr.sync_thread()

    return forward, both


def through_renderer(scene: GaussianScene, camera: Camera) -> Runs:
    """Forward, and forward + backward, from torch to torch."""
    from mi_splat.render.renderer import Renderer

    render = Renderer()
    leaves = [tensor.clone().requires_grad_(True) for tensor in scene.tensors()]
    learnt = GaussianScene(*leaves)
    weights = torch.randn(
        camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1)
    )

    def forward() -> None:
        with torch.no_grad():
            render(scene, camera)

    def both() -> None:
        for leaf in leaves:
            leaf.grad = None
        (render(learnt, camera) * weights).sum().backward()  # type: ignore[no-untyped-call]

    return forward, both


def camera_of(size: int) -> Camera:
    """The camera for square images of this many pixels."""
    pose = orbit_pose((0.0, 0.0, 0.0), azimuth=30.0, elevation=20.0, distance=3.0)
    return Camera(to_world=pose, lens=Lens(focal=float(size), size=(size, size)))


def runs() -> dict[str, Callable[[], None]]:
    """Our renderer in all settings and with a million Gaussians; for cpu_time.py."""
    named: dict[str, Callable[[], None]] = {}
    for count, size in (*SETTINGS, (1_000_000, 640)):
        pair = through_renderer(shell(count), camera_of(size))
        named |= {
            f"{count:,} at {size}, {label}": run
            for label, run in zip(("forward", "both"), pair, strict=True)
        }
    return named


def measure(count: int, size: int, rounds: int, now: Clock) -> dict[str, Any]:
    """Median times in ms, and medians of the ratios to the peer, for one setting."""
    scene = shell(count)
    camera = camera_of(size)
    ways = {
        "volprim_rf_basic": through_mitsuba(scene, camera, "volprim_rf_basic"),
        "splat_tile": through_mitsuba(scene, camera, "splat_tile"),
        "splat_ray": through_mitsuba(scene, camera, "splat_ray"),
        "Renderer": through_renderer(scene, camera),
    }
    labels = ("forward", "forward + backward")
    runs = {
        f"{name}, {label}": run
        for name, pair in ways.items()
        for label, run in zip(labels, pair, strict=True)
    }
    times = interleaved(runs, rounds=rounds, now=now)
    row: dict[str, Any] = {"gaussians": count, "size": size}
    for label in labels:
        peer = times[f"volprim_rf_basic, {label}"]
        row[label] = {
            name: {
                "ms": round(1e3 * statistics.median(times[f"{name}, {label}"]), 2),
                "ratio": round(ratio(peer, times[f"{name}, {label}"]), 1),
            }
            for name in ways
        }
    return row


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description="Time splat_tile beside volprim_rf_basic."
    )
    parser.add_argument(
        "--rounds", type=int, default=15, help="interleaved runs of everything"
    )
    add_cpu_flag(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # torch's threads and Dr.Jit's would fight over the cores
    variant.use()
    now = clock(arguments.cpu)
    rows = [measure(count, size, arguments.rounds, now) for count, size in SETTINGS]
    if arguments.json:
        print(json.dumps(rows, indent=2))  # noqa: T201
        return
    for row in rows:
        for label in ("forward", "forward + backward"):
            cells = "   ".join(
                f"{name} {v['ms']:8.1f} ms {v['ratio']:5.1f}x"
                for name, v in row[label].items()
            )
            print(f"{row['gaussians']:>7,} at {row['size']}: {label:<18} {cells}")  # noqa: T201


if __name__ == "__main__":
    main()
