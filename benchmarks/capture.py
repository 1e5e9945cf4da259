"""Path-traced pictures, in CPU time of one thread:
`python benchmarks/cpu_time.py benchmarks/capture.py`.

A picture of a car on a road and one of a car on its street, both 256 x 256 at 32
samples, by Mitsuba's LLVM variant, which captures use, and by its scalar variant; and
what the first picture of a scene takes, where loading comes with it.
"""

from collections.abc import Callable

import mitsuba as mi

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.capture.path_tracer import (
    FEW_PICTURES,
    MANY_PICTURES,
    PathTracer,
    tracing_variant,
)
from mi_splat.capture.sources import open_source

SIZE = 256
SAMPLES = 32
SCENES = ("car", "car_street")
ANGLES = (0.0, 60.0, 120.0)
"""Azimuths of the pictures, of which each run takes the next one."""


def runs() -> dict[str, Callable[[], object]]:
    """Pictures by scene and variant."""
    return {
        f"{what} of {name}, {variant}": run
        for name in SCENES
        for variant in (MANY_PICTURES, FEW_PICTURES)
        for what, run in _of(name, variant).items()
    }


def _of(name: str, variant: str) -> dict[str, Callable[[], object]]:
    with tracing_variant(variant):
        source = open_source(name)
        tracer = PathTracer(source.scene, samples=SAMPLES)
    cameras = [
        Camera(
            to_world=orbit_pose(
                source.centre,
                azimuth=azimuth,
                elevation=25.0,
                distance=3 * source.radius,
            ),
            lens=Lens(focal=float(SIZE), size=(SIZE, SIZE)),
        )
        for azimuth in ANGLES
    ]
    taken = 0

    def picture() -> None:
        nonlocal taken
        # switching takes 0.2 s; here it is part of the runs that are not timed
        mi.set_variant(variant)
        tracer.picture(cameras[taken % len(cameras)], seed=taken)
        taken += 1

    def first() -> None:
        mi.set_variant(variant)
        PathTracer(source.scene, samples=SAMPLES).picture(cameras[0], seed=0)

    return {"a picture": picture, "loading and first picture": first}
