"""Mitsuba plugins of this project: the shape `gaussians`, the integrators `splat_tile`
and `splat_ray`.

Importing this package is enough: the plugins are registered in the current variant, and
again whenever another one that can render splats is set.

A scene file from somebody else is read with `mi_splat.read_scene`. Plain `mi.load_file`
loads native code that lies beside the file: `plugins/NAME.so` for every plugin type
that Mitsuba has not loaded yet, one of its own included.
"""

import functools
import importlib
import os
from typing import Any

import mitsuba as mi

from mi_splat.errors import InvalidValueError
from mi_splat.render.setup import prepare_llvm

SUPPORTED_VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Mitsuba variants in which the plugins exist."""


@functools.cache
def _register_in(variant: str) -> None:
    from mi_splat.render.plugins import shape, tile

    @functools.cache
    def splat_ray() -> Any:  # most scenes do without its paths
        from mi_splat.render.plugins import ray

        return ray.integrator_class(variant)

    mi.register_shape("gaussians", shape.gaussians)
    mi.register_integrator("splat_tile", tile.integrator_class(variant))
    mi.register_integrator("splat_ray", lambda props: splat_ray()(props))


@functools.cache
def _refuse_in(variant: str) -> None:
    """Let the plugins say, in a variant without colours in RGB or without derivatives,
    which ones they need.
    """

    def refuse(props: Any) -> Any:
        expected = " or ".join(SUPPORTED_VARIANTS)
        do = f'call mi.set_variant("{SUPPORTED_VARIANTS[0]}") first'
        raise InvalidValueError.of(
            f"variant for {props.plugin_name()}", expected, variant, do
        )

    mi.register_shape("gaussians", refuse)
    for name in ("splat_tile", "splat_ray"):
        mi.register_integrator(name, refuse)


def _on_variant(old: str | None, new: str | None) -> None:
    if new in SUPPORTED_VARIANTS:
        if new.startswith("llvm") and not os.environ.get("DRJIT_LIBLLVM_PATH"):
            prepare_llvm()
        _register_in(new)
        importlib.import_module(
            "mi_splat.render.plugins.gaussian_shapes"
        ).watch_rendering()
    elif new:
        _refuse_in(new)


mi.detail.add_variant_callback(_on_variant)
_on_variant(None, mi.variant())
