"""`mi-splat render`: a scene XML or a splat file to a PNG."""

from __future__ import annotations

import dataclasses
import time

import torch

from mi_splat.cameras import Camera
from mi_splat.cli.console import progress, show, show_json
from mi_splat.cli.options import RenderOptions
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes
from mi_splat.rendering import Renderer
from mi_splat.scene_files import SplatScene, choose_camera, open_scene, orbit_camera, resized


def run(options: RenderOptions) -> int:
    """Render and save the picture."""
    with progress("rendering"):
        loaded = open_scene(options.scene)
        camera = _camera(loaded, options)
        settings = loaded.settings
        if options.background is not None:
            settings = dataclasses.replace(settings, background=options.background)
        if options.near is not None:
            settings = dataclasses.replace(settings, near=options.near)
        begun = time.perf_counter()
        with torch.no_grad():
            picture = Renderer(settings)(loaded.scene, camera)
        options.out.parent.mkdir(parents=True, exist_ok=True)
        save_png(to_bytes(picture), options.out)
    seconds = time.perf_counter() - begun
    if options.json:
        show_json(
            {
                "out": str(options.out),
                "gaussians": len(loaded.scene),
                "width": camera.width,
                "height": camera.height,
                "camera_to_world": camera.to_world.tolist(),
                "focal": [camera.fx, camera.fy],
                "seconds": seconds,
            }
        )
    else:
        size = f"{camera.width} x {camera.height}"
        show(
            f"{options.out}: {len(loaded.scene):,} Gaussians at {size} in {seconds:.2f} s (the first picture compiles)"
        )
    return 0


def _camera(loaded: SplatScene, options: RenderOptions) -> Camera:
    """The camera that the options describe."""
    orbit = any(value is not None for value in (options.azimuth, options.elevation, options.distance, options.target))
    if options.camera is not None or (loaded.cameras and not orbit):
        camera = choose_camera(loaded, options.camera, options.scene)
        return camera if options.size is None else resized(camera, options.size)
    return orbit_camera(
        loaded.scene,
        azimuth=30.0 if options.azimuth is None else options.azimuth,
        elevation=20.0 if options.elevation is None else options.elevation,
        distance=options.distance,
        fov=options.fov,
        size=options.size or (640, 480),
        target=options.target,
    )
