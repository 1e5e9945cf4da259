"""`mi-splat render`: a scene XML or a splat file as an image, as many images, or as
an animation.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from mi_splat.cli.console import progress, show_result
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import CameraOptions, JsonOptions, Rate, Samples
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Metavar, OutFile

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    from mi_splat.cameras.camera import Camera, RenderFn
    from mi_splat.render.scene_files import MixedScene
    from mi_splat.scene import GaussianScene

    Pixels = NDArray[np.uint8] | Mapping[str, NDArray[np.float32]]


EXAMPLES = (
    "render scenes/car_street.xml --out car.png",
    "render YOUR.ply --azimuth 40 --elevation 15 --out desk.png",
    "render YOUR.ply --cameras orbit:60@20 --out desk.gif",
    "render YOUR.ply --alpha --depth --out desk.exr",
)


@dataclass(frozen=True, kw_only=True)
class RenderOptions(JsonOptions):
    """Render a scene XML or a splat file: one image, an image for each of several
    cameras, or an animation.

    A scene XML with meshes beside splats is path traced by its integrator splat_ray.

    By default a scene XML is rendered from its first camera, and a splat file from an
    orbit camera around the centre of its Gaussians, at a distance that shows all of
    them.
    """

    scene: Positional[Path]
    """Scene XML of splats, alone or among meshes, or a splat file of any format that is
    read.
    """
    out: Annotated[OutFile, Metavar("PATH")] = Path("picture.png")
    """What to write: NAME.png or NAME.jpg; NAME.exr with linear values as 32-bit
    floats; NAME.gif or NAME.webp of several cameras one after the other; a folder, for
    one image per camera.
    """
    view: CameraOptions = field(default_factory=CameraOptions)
    """Where from."""
    fps: Rate = 24.0
    """Frames per second of an animation."""
    method: Literal["tile", "ray"] | None = None
    """Renderer for scenes of splats only: tile matches the reference 3DGS rasteriser,
    ray traces rays. Default: that of the scene XML, else tile.
    """
    alpha: bool = False
    """Also write opacity, as channel A of NAME.exr; colours remain composited over the
    background.
    """
    depth: bool = False
    """Also write depth along the camera's axis, in world units: expected depth as
    channel Z of NAME.exr (0 where nothing is), and median depth as median.Z, where half
    of the light is blocked (0 where less is).
    """
    samples: Samples = 64
    """Samples per pixel, for a scene with meshes; other images need only one."""
    force: bool = False
    """Replace an existing file, or a folder of images that an earlier call has written.
    """


RECORD = "cameras.json"
"""In a folder of images, the camera of each."""


def run(options: RenderOptions) -> None:
    """Render and save."""
    import torch

    from mi_splat.cli.cameras import find_cameras, render_settings, renderer_of
    from mi_splat.io.camera_records import describe
    from mi_splat.io.folders import check_not_input
    from mi_splat.io.images import is_floats
    from mi_splat.render.scene_files import open_scene

    floats = is_floats(options.out)
    check_not_input(options.out, options.scene)
    with progress("loading") as advance:
        mixed = _mixed_scene(options)
        loaded = open_scene(options.scene) if mixed is None else mixed.splats
        if options.method is not None:
            mode = loaded.settings.antialiased and options.method == "tile"
            changed = dataclasses.replace(
                loaded.settings, method=options.method, antialiased=mode
            )
            loaded = dataclasses.replace(loaded, settings=changed)
        if floats:
            loaded = dataclasses.replace(
                loaded, settings=dataclasses.replace(loaded.settings, linear=True)
            )
        cameras = find_cameras(loaded, options.view)
        _check_out(options, cameras)
        _check_channels(options, loaded.settings.method)
        settings = render_settings(loaded, options.view, cameras)
        render: RenderFn = (
            renderer_of(loaded, options.view, cameras) if mixed is None else mixed
        )
        begun = time.perf_counter()
        pictures = {}
        for number, (name, camera) in enumerate(cameras.items(), 1):
            advance(f"rendering {number} of {len(cameras)}")
            with torch.no_grad():
                pictures[name] = _pixels(render, loaded.scene, camera, options)
        files = _save(pictures, cameras, options)
    seconds = time.perf_counter() - begun
    first = next(iter(cameras.values()))
    document = {
        "out": str(options.out),
        "files": [str(file) for file in files],
        "gaussians": len(loaded.scene),
        "width": first.width,
        "height": first.height,
        "near": settings.near,
        "camera_to_world": first.to_world.tolist(),
        "focal": list(first.lens.scale),
        "cameras": [describe(name, camera) for name, camera in cameras.items()],
        "seconds": seconds,
    }
    many = f"{len(cameras)} images, " if len(cameras) > 1 else ""
    size = f"{first.width} x {first.height}"
    took = f"{seconds:.2f} s (the first image compiles)"
    line = f"{options.out}: {many}{len(loaded.scene):,} Gaussians at {size} in {took}"
    show_result(document, line, as_json=options.json)


def _mixed_scene(options: RenderOptions) -> MixedScene | None:
    """The scene, where it holds surfaces beside splats."""
    from mi_splat.io.images import is_floats
    from mi_splat.render.scene_files import MixedScene, holds_surfaces

    if options.scene.suffix.lower() != ".xml" or not holds_surfaces(options.scene):
        return None
    given = {
        "--method": options.method,
        "--background": options.view.background,
        "--near": options.view.near,
    }
    given |= {"--alpha": options.alpha or None, "--depth": options.depth or None}
    idle = [flag for flag, value in given.items() if value is not None]
    if idle:
        do = "leave it out: the scene file says how it is rendered"
        raise InvalidValueError.of(
            "scene with meshes", "flags that it can follow", ", ".join(idle), do
        )
    return MixedScene(
        options.scene, samples=options.samples, linear=is_floats(options.out)
    )


def _check_channels(options: RenderOptions, method: str) -> None:
    """Raise, before anything is rendered, unless what --alpha and --depth ask for can
    be made and written.
    """
    from mi_splat.io.images import is_floats

    flags = [
        flag
        for flag, given in (("--alpha", options.alpha), ("--depth", options.depth))
        if given
    ]
    if flags and not is_floats(options.out):
        do = "end it in .exr, which has channels for them"
        raise InvalidValueError.of(
            f"--out with {' and '.join(flags)}",
            "a name that ends in .exr",
            options.out,
            do,
        )
    if options.depth and method != "tile":
        do = "leave one of them out: along a ray a Gaussian has no one depth"
        raise InvalidValueError.of("--depth", "--method tile", method, do)


def _pixels(
    render: RenderFn, scene: GaussianScene, camera: Camera, options: RenderOptions
) -> Pixels:
    """An image as its file has it: bytes, or float channels by name."""
    from mi_splat.io.images import is_floats, to_bytes
    from mi_splat.render.renderer import Renderer

    if not is_floats(options.out):
        return to_bytes(render(scene, camera))
    more: dict[str, Tensor] = {}
    if isinstance(render, Renderer) and options.depth:
        seen = render.outputs(scene, camera)
        image = seen.image
        more = {"A": seen.alpha, "Z": seen.depth, "median.Z": seen.median_depth}
    elif isinstance(render, Renderer) and options.alpha:
        image = Renderer(dataclasses.replace(render.settings, alpha=True))(
            scene, camera
        )
        more = {"A": image[..., 3]}
    else:
        image = render(scene, camera)
    if not options.alpha:
        more.pop("A", None)
    planes = {"R": image[..., 0], "G": image[..., 1], "B": image[..., 2], **more}
    return {name: plane.cpu().numpy() for name, plane in planes.items()}


def _check_out(options: RenderOptions, cameras: Mapping[str, Camera]) -> None:
    from mi_splat.io.folders import check_free_file, check_new_folder
    from mi_splat.io.images import is_animation, is_floats, is_picture

    out = options.out
    if is_animation(out) or is_picture(out) or is_floats(out):
        check_free_file(out, force=options.force)
    if is_animation(out):
        if len(cameras) < 2:
            do = "pass for instance --cameras orbit:60@20, or end the name in .png"
            raise InvalidValueError.of(
                "--out", "two cameras or more for an animation", f"one, {out}", do
            )
        sizes = {f"{camera.width} x {camera.height}" for camera in cameras.values()}
        if len(sizes) > 1:
            raise InvalidValueError.of(
                "--out", "cameras of one size", ", ".join(sorted(sizes)), "pass --size"
            )
    elif is_picture(out) or is_floats(out):
        if len(cameras) > 1:
            do = "name a folder, or a .gif or .webp"
            raise InvalidValueError.of(
                "--out", f"room for {len(cameras)} images", out, do
            )
    elif out.suffix:
        expected = "a name that ends in .png, .jpg, .exr, .gif or .webp, or a folder"
        raise InvalidValueError.of("--out", expected, out, "change the ending")
    else:
        check_new_folder(out, force=options.force, record=RECORD)


def _save(
    pictures: Mapping[str, Pixels],
    cameras: Mapping[str, Camera],
    options: RenderOptions,
) -> list[Path]:
    from mi_splat.io.camera_records import describe
    from mi_splat.io.documents import file_name, save_json
    from mi_splat.io.folders import new_folder
    from mi_splat.io.images import (
        is_animation,
        is_floats,
        is_picture,
        save_animation,
        save_picture,
    )
    from mi_splat.render.renderer import save_floats

    out = options.out
    shown = [pixels for pixels in pictures.values() if not isinstance(pixels, Mapping)]
    if is_animation(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        save_animation(shown, out, fps=options.fps)
        return [out]
    if is_picture(out) or is_floats(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        for pixels in pictures.values():
            (
                save_floats(pixels, out)
                if isinstance(pixels, Mapping)
                else save_picture(pixels, out)
            )
        return [out]
    with new_folder(out, force=options.force, record=RECORD) as folder:
        for name, pixels in zip(pictures, shown, strict=True):
            save_picture(pixels, folder / f"{file_name(name)}.png")
        save_json(
            [describe(name, camera) for name, camera in cameras.items()],
            folder / RECORD,
        )
    return [*(out / f"{file_name(name)}.png" for name in pictures), out / RECORD]
