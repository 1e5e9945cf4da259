"""The methods that can be compared: renderers by name, and folders of images that
another program has made.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.datasets import DatasetError
from mi_splat.datasets.frames import picture_size, read_picture
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import file_name
from mi_splat.io.images import PICTURES
from mi_splat.maths.sh import colour_to_dc, dc_to_colour, sh_basis
from mi_splat.registry import Registry
from mi_splat.render.renderer import Method as Way
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import MixedScene
from mi_splat.render.volprim import Volprim
from mi_splat.scene import GaussianScene

FOLDER = "folder:"
"""Begins a method that is a folder of images."""
PATH_TRACED = re.compile(r"path-traced-(\d{1,5})")
"""A method of scenes with meshes: splats and meshes path traced together, with so many
samples a pixel.
"""
SAMPLES_BELOW = 16
"""Samples a pixel of the meshes over which other methods are composited."""
NEAR = 3.0
"""Near plane of `tile-near-3`, world units; the shipped cameras stand about 6 from
their object.
"""
MakeRender = Callable[[RenderSettings], RenderFn]
"""Makes a renderer for a background and a near plane."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """One way to make the images; `renders` says that its time means something,
    `bits` are of a channel.
    """

    render: RenderFn
    differentiable: bool = True
    renders: bool = True
    bits: int = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class RendererSpec:
    """A renderer that is known by a name.

    Attributes:
        make: Takes the settings of the images (`background`, `near`) and returns the
            renderer, a `RenderFn`. It is called when the renderer is asked for, so it
            may import what is slow, and raise `MiSplatError` where the renderer cannot
            run.
        differentiable: Whether `backward` through its images gives gradients of the
            scene's five tensors.
    """

    make: MakeRender
    differentiable: bool = True


RENDERERS: Registry[RendererSpec] = Registry(
    "mi_splat.renderers",
    "a RendererSpec",
    lambda value: isinstance(value, RendererSpec),
    what="renderer",
)
"""Name to spec of every renderer; `mi-splat compare`, studies and conditions know them
by these.
"""


def register_method(
    name: str, make: MakeRender, *, differentiable: bool = True
) -> None:
    """Let a renderer join comparisons under a name."""
    if not re.fullmatch(r"[a-z][a-z0-9_-]*", name):
        expected = "small letters, digits, - and _, a letter first"
        raise InvalidValueError.of("name of a method", expected, name, "choose another")
    RENDERERS.add(name, RendererSpec(make=make, differentiable=differentiable))


def load_methods(
    arguments: Sequence[str],
    settings: RenderSettings,
    cameras: Mapping[str, Camera],
    *,
    meshes: Callable[[int], MixedScene] | None = None,
) -> dict[str, Method]:
    """The methods that are asked for, by name, in their order; `meshes` makes a scene
    of splats among meshes.
    """
    methods: dict[str, Method] = {}
    for word in filter(
        None, (part.strip() for given in arguments for part in given.split(","))
    ):
        if word.startswith(FOLDER):
            name = Path(word.removeprefix(FOLDER)).resolve().name
        else:
            name = word
        if name in methods:
            do = "name each once, and rename a folder that is called like a method"
            raise InvalidValueError.of(
                "methods", "different names", f"{name} twice", do
            )
        if word.startswith(FOLDER):
            pictures = PictureFolder(
                Path(word.removeprefix(FOLDER)), cameras, background=settings.background
            )
            methods[name] = Method(
                render=pictures, differentiable=False, renders=False, bits=8
            )
        elif meshes is not None and (traced := PATH_TRACED.fullmatch(word)):
            methods[name] = Method(render=meshes(int(traced[1])), differentiable=False)
        elif word in RENDERERS:
            methods[name] = load_method(word, settings)
            if meshes is not None:
                methods[name] = Method(
                    render=OverMeshes(methods[name].render, meshes(SAMPLES_BELOW)),
                    differentiable=False,
                )
        else:
            expected = f"one of {', '.join(RENDERERS)}, or {FOLDER}PATH"
            raise InvalidValueError.of("methods", expected, word, "choose one of them")
    if len(methods) < 2:
        got = ", ".join(methods) or "none"
        raise InvalidValueError.of(
            "methods", "two or more", got, "name what to compare, for instance tile,ray"
        )
    return methods


def load_method(name: str, settings: RenderSettings) -> Method:
    """One renderer by its name."""
    spec = RENDERERS.chosen(name)
    return Method(render=spec.make(settings), differentiable=spec.differentiable)


def _own(
    settings: RenderSettings,
    *,
    method: Way,
    colour_to_mean: bool = False,
    antialiased: bool = False,
) -> Renderer:
    """The project's own renderer; see `RenderSettings`."""
    changed = dataclasses.replace(
        settings,
        method=method,
        colour_to_mean=colour_to_mean,
        antialiased=antialiased,
        alpha=False,
        linear=False,
    )
    return Renderer(changed)


register_method("tile", functools.partial(_own, method="tile"))
register_method(
    "tile-antialiased", functools.partial(_own, method="tile", antialiased=True)
)
register_method(
    "tile-near-3",
    lambda settings: _own(dataclasses.replace(settings, near=NEAR), method="tile"),
)
register_method(
    "tile-colours-in-0-1", lambda settings: cut_to_bytes(_own(settings, method="tile"))
)
register_method(
    "tile-colours-not-cut", lambda settings: not_cut(_own(settings, method="tile"))
)
register_method("ray", functools.partial(_own, method="ray"))
register_method(
    "ray-to-mean", functools.partial(_own, method="ray", colour_to_mean=True)
)
register_method("volprim", Volprim)


# 3D Gaussian Splatting cuts a colour at 0 alone. A program that stores colours in bytes
# before it blends keeps them in [0, 1]; one that blends first and cuts last does not
# cut them at all.


def cut_to_bytes(render: RenderFn) -> RenderFn:
    """A renderer that keeps the colour of each Gaussian in [0, 1]."""
    return lambda scene, camera: render(
        _coloured(scene, _colours(scene, camera).clamp(0, 1)), camera
    )


def not_cut(render: RenderFn) -> RenderFn:
    """A renderer that lets colours be negative, and blends them as they are.

    An image is linear in the colours, so that it is that of what is positive less that
    of what is negative, without the background, of which a splat of black Gaussians
    shows what is seen.
    """

    def uncut(scene: GaussianScene, camera: Camera) -> Tensor:
        colours = _colours(scene, camera)
        light, dark, black = (
            render(_coloured(scene, part), camera)
            for part in (
                colours.clamp(min=0),
                (-colours).clamp(min=0),
                torch.zeros_like(colours),
            )
        )
        return light - (dark - black)

    return uncut


def _colours(scene: GaussianScene, camera: Camera) -> Tensor:
    """(N, 3) what a camera sees of each Gaussian, not cut."""
    directions = functional.normalize(
        scene.means - camera.position.to(scene.means), dim=-1
    )
    basis = sh_basis(directions, scene.degree)
    return dc_to_colour(torch.zeros(1)) + (basis[..., None] * scene.sh).sum(1)


def _coloured(scene: GaussianScene, colours: Tensor) -> GaussianScene:
    return scene.replace(sh=colour_to_dc(colours)[:, None])


class OverMeshes:
    """Images of splats composited over path-traced ones of meshes alone, with a depth
    test for each pixel.

    So neither casts a shadow on the other or is mirrored in it. The depth of the splat
    is that of `tile`.
    """

    def __init__(self, render: RenderFn, meshes: MixedScene) -> None:
        self._render = render
        self._meshes = meshes
        self._depth = Renderer(RenderSettings(near=meshes.splats.settings.near))

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """The composite."""
        behind = self._meshes(
            scene.replace(opacities=torch.zeros_like(scene.opacities)), camera
        )
        covered = self._render(_coloured(scene, torch.ones_like(scene.means)), camera)
        hidden = self._meshes.depths(camera) < self._depth.outputs(scene, camera).depth
        return torch.where(
            hidden[..., None],
            behind,
            self._render(scene, camera) + (1 - covered) * behind,
        )


class PictureFolder:
    """A `RenderFn` that reads the image of each camera from a folder, named as
    `mi-splat render` names its own.
    """

    def __init__(
        self,
        folder: Path,
        cameras: Mapping[str, Camera],
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        if not folder.is_dir():
            raise InvalidValueError.of(
                str(folder), "a folder of images", "none", "check the path"
            )
        self.background = background
        self._cameras = dict(cameras)
        self._paths = {name: _path(folder, name) for name in cameras}
        for name, camera in cameras.items():
            picture_size(self._paths[name], (camera.width, camera.height))

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """The image of a camera."""
        name = next(
            (name for name, known in self._cameras.items() if known is camera), None
        )
        if name is None:
            do = "pass a camera that the folder was opened with"
            raise InvalidValueError.of(
                "camera", f"one of {', '.join(self._cameras)}", "another", do
            )
        return read_picture(self._paths[name], downscale=1, background=self.background)[
            0
        ].to(scene.means.device)


def _path(folder: Path, name: str) -> Path:
    stem = file_name(name)
    path = next(
        (
            folder / f"{stem}{ending}"
            for ending in PICTURES
            if (folder / f"{stem}{ending}").is_file()
        ),
        None,
    )
    if path is None:
        held = sorted(entry.name for entry in folder.iterdir())[:3]
        got = f"none among {', '.join(held)}, ..." if held else "an empty folder"
        do = "call images as their cameras, as `mi-splat render --out FOLDER` does"
        raise DatasetError.of(str(folder), f"{stem}.png for the camera {name}", got, do)
    return path
