"""The methods that can be compared: renderers by name, and folders of pictures that another program has made."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mi_splat.cameras import Camera, RenderFn
from mi_splat.comparison.colour_clamps import cut_to_bytes, not_cut
from mi_splat.comparison.gsplat_renderer import GsplatRenderer
from mi_splat.comparison.picture_folder import PictureFolder
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Method as Way
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.volprim import Volprim

FOLDER = "folder:"
"""Begins a method that is a folder of pictures."""
NEAR = 3.0
"""Near plane of `tile-near-3`, world units; the shipped cameras stand about 6 from their object."""
MakeRender = Callable[[RenderSettings], RenderFn]
"""Makes a renderer for a background and a near plane."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """One way to make the pictures.

    Attributes:
        render: Scene and camera to (H, W, 3) sRGB.
        differentiable: Whether its gradients are compared.
        renders: Whether it does its work when it is called, so that its time and memory mean something.
        bits: Of a channel of its pictures: 32 of floats, 8 of files.
    """

    render: RenderFn
    differentiable: bool = True
    renders: bool = True
    bits: int = 32


@dataclass(frozen=True, slots=True)
class _Maker:
    make: MakeRender
    differentiable: bool


_MAKERS: dict[str, _Maker] = {}


def register_method(name: str, make: MakeRender, *, differentiable: bool = True) -> None:
    """Let a renderer join comparisons under a name.

    Args:
        name: What `--methods` calls it: small letters, digits, dashes and underscores, a letter first.
        make: Takes the settings of the pictures (`background`, `near`) and returns the renderer, a `RenderFn`. It is
            called when the method is asked for, so it may import what is slow, and raise `MiSplatError` where the
            renderer cannot run.
        differentiable: Whether `backward` through its pictures gives gradients of the scene's five tensors.

    Raises:
        InvalidValueError: The name cannot be, or is taken.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_-]*", name):
        expected = "small letters, digits, - and _, a letter first"
        raise InvalidValueError.of("name of a method", expected, name, "choose another")
    if name in _MAKERS:
        raise InvalidValueError.of("name of a method", "a new one", name, "choose another")
    _MAKERS[name] = _Maker(make, differentiable)


def method_names() -> tuple[str, ...]:
    """The renderers that are known by name."""
    return tuple(_MAKERS)


def load_methods(
    arguments: Sequence[str], settings: RenderSettings, cameras: Mapping[str, Camera]
) -> dict[str, Method]:
    """The methods that are asked for, by name, in their order.

    Args:
        arguments: Names of renderers, and folders of pictures as `folder:PATH`, which are called by the folder's name.
            Several in one word stand between commas.
        settings: Background and near plane.
        cameras: From which the pictures of a folder were made, by name.

    Raises:
        InvalidValueError: There is no such method, one is named twice, there are fewer than two, or a method cannot
            work with the settings.
        DatasetError: A folder lacks a picture, or has one of another size.
        MiSplatError: A renderer cannot run here.
    """
    methods: dict[str, Method] = {}
    for word in filter(None, (part.strip() for given in arguments for part in given.split(","))):
        name = Path(word.removeprefix(FOLDER)).resolve().name if word.startswith(FOLDER) else word
        if name in methods:
            do = "name each once, and rename a folder that is called like a method"
            raise InvalidValueError.of("methods", "different names", f"{name} twice", do)
        if word.startswith(FOLDER):
            pictures = PictureFolder(Path(word.removeprefix(FOLDER)), cameras, background=settings.background)
            methods[name] = Method(render=pictures, differentiable=False, renders=False, bits=8)
        elif word in _MAKERS:
            methods[name] = load_method(word, settings)
        else:
            expected = f"one of {', '.join(_MAKERS)}, or {FOLDER}PATH"
            raise InvalidValueError.of("methods", expected, word, "choose one of them")
    if len(methods) < 2:
        got = ", ".join(methods) or "none"
        raise InvalidValueError.of("methods", "two or more", got, "name what to compare, for instance tile,ray")
    return methods


def load_method(name: str, settings: RenderSettings) -> Method:
    """One renderer by its name.

    Args:
        name: One of `method_names()`.
        settings: Background and near plane.

    Raises:
        InvalidValueError: There is none of this name, or it cannot work with the settings.
        MiSplatError: It cannot run here.
    """
    if name not in _MAKERS:
        raise InvalidValueError.of("renderer", f"one of {', '.join(_MAKERS)}", name, "choose one of them")
    return Method(render=_MAKERS[name].make(settings), differentiable=_MAKERS[name].differentiable)


def _own(settings: RenderSettings, *, method: Way, colour_to_mean: bool = False, antialiased: bool = False) -> Renderer:
    """The project's own renderer.

    Args:
        settings: Background and near plane.
        method: As in `RenderSettings`, like all that follow.
        colour_to_mean: See `method`.
        antialiased: See `method`.
    """
    changed = {"method": method, "colour_to_mean": colour_to_mean, "antialiased": antialiased}
    return Renderer(dataclasses.replace(settings, **changed, alpha=False, linear=False))  # type: ignore[arg-type]


register_method("tile", functools.partial(_own, method="tile"))
register_method("tile-antialiased", functools.partial(_own, method="tile", antialiased=True))
register_method("tile-near-3", lambda settings: _own(dataclasses.replace(settings, near=NEAR), method="tile"))
register_method("tile-colours-in-0-1", lambda settings: cut_to_bytes(_own(settings, method="tile")))
register_method("tile-colours-not-cut", lambda settings: not_cut(_own(settings, method="tile")))
register_method("ray", functools.partial(_own, method="ray"))
register_method("ray-to-mean", functools.partial(_own, method="ray", colour_to_mean=True))
register_method("volprim", Volprim)
register_method("gsplat", GsplatRenderer)
