"""Renderers that cut a Gaussian's colour elsewhere than at 0: some do not cut it, some keep it in [0, 1].

3D Gaussian Splatting cuts at 0 alone. A program that stores colours in bytes before it blends keeps them in [0, 1], one
that blends first and cuts last does not cut them at all.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.cameras import Camera, RenderFn
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc, dc_to_colour, sh_basis


def cut_to_bytes(render: RenderFn) -> RenderFn:
    """A renderer that keeps the colour of each Gaussian in [0, 1]."""
    return lambda scene, camera: render(_coloured(scene, _colours(scene, camera).clamp(0, 1)), camera)


def not_cut(render: RenderFn) -> RenderFn:
    """A renderer that lets colours be negative, and blends them as they are.

    A picture is linear in the colours, so that it is that of what is positive less that of what is negative, without
    the background, of which a splat of black Gaussians shows what is seen.
    """

    def uncut(scene: GaussianScene, camera: Camera) -> Tensor:
        colours = _colours(scene, camera)
        light, dark, black = (
            render(_coloured(scene, part), camera)
            for part in (colours.clamp(min=0), (-colours).clamp(min=0), torch.zeros_like(colours))
        )
        return light - (dark - black)

    return uncut


def _colours(scene: GaussianScene, camera: Camera) -> Tensor:
    """(N, 3) what a camera sees of each Gaussian, not cut."""
    directions = functional.normalize(scene.means - camera.position.to(scene.means), dim=-1)
    basis = sh_basis(directions, scene.degree)
    return dc_to_colour(torch.zeros(1)) + (basis[..., None] * scene.sh).sum(1)


def _coloured(scene: GaussianScene, colours: Tensor) -> GaussianScene:
    return scene.replace(sh=colour_to_dc(colours)[:, None])
