"""FrozenView: images of one scene from one camera in which only colours change, much
faster than by a Renderer.

It crosses from torch to Dr.Jit by a `torch.autograd.Function` around calls that
differentiate by hand, where `Renderer` has `dr.wrap` around a node of Dr.Jit's own
graph.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import drjit as dr
import mitsuba as mi
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import degree_of
from mi_splat.maths.srgb import tensor_to_linear
from mi_splat.render import variant
from mi_splat.render.renderer import RenderSettings
from mi_splat.render.tile import layouts
from mi_splat.render.tile.colour_steps import gradient_of, picture_of
from mi_splat.render.tile.frozen import aligned
from mi_splat.render.tile.pinhole import Pinhole
from mi_splat.render.tile.pipeline import rasterize
from mi_splat.render.tile.weights import HIDDEN_DC, freeze_pairs
from mi_splat.scene import GaussianScene, check_rows, check_scene

MAX_BYTES = 2 << 30
"""What a `FrozenView` may take where nothing else is said."""


class FrozenView:
    """The image of one scene from one camera as a function of SH alone.

    Made once, at about the cost of a few images: it keeps what each Gaussian
    contributes to each pixel. A step then needs no projection, no sort and no
    exponential. Image and gradient are those of a `Renderer` but for rounding, and
    the same bits every time, on any number of threads. SH of another degree than the
    scene's are welcome.

    Args:
        scene: N Gaussians, as they are now: the view sees no later change.
        camera: The camera.
        settings: How to render; the method has to be "tile".
        rows: The Gaussians whose colours may change, as a (N,) bool mask, (M,) integer
            indices, each once, or a slice; all if None. The others are a constant
            image, and tiles without any of `rows` are never computed again.
        max_bytes: Upper bound of `nbytes`, what the view keeps and a step takes;
            checked before memory is taken.
    """

    def __init__(
        self,
        scene: GaussianScene,
        camera: Camera,
        *,
        settings: RenderSettings | None = None,
        rows: Tensor | slice | None = None,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        check_scene("scene", scene)
        self.settings = settings or RenderSettings()
        if self.settings.method != "tile":
            do = "use a Renderer, which has no weights of tiles to keep for it"
            raise InvalidValueError.of(
                "FrozenView", 'the method "tile"', f'"{self.settings.method}"', do
            )
        self.variant = variant.use(self.settings.variant)
        self._device = scene.means.device
        device = variant.device_of(self.variant)
        if self._device.type != device:
            raise InvalidValueError.of(
                "scene",
                f"tensors on {device}",
                self._device,
                f'call scene.to("{device}")',
            )
        self.rows = _indices(rows, len(scene)).to(self._device)
        self._kept = [
            tensor.detach().to(torch.float32, copy=True).contiguous()
            for tensor in scene.tensors()
        ]
        self._kept[4][self.rows] = 0.0
        self._kept[4][self.rows, 0] = HIDDEN_DC
        self._look(camera, max_bytes, held=sum(tensor.nbytes for tensor in self._kept))

    def at(self, camera: Camera, *, max_bytes: int = MAX_BYTES) -> FrozenView:
        """The same scene, settings and rows seen from another camera; what the views
        know of the scene is kept once.
        """
        view = copy.copy(self)
        _make_current(self.variant)
        view._look(camera, max_bytes, held=0)
        return view

    def _look(self, camera: Camera, max_bytes: int, *, held: int) -> None:
        """Fill what belongs to one camera, with `held` bytes taken before."""
        if not isinstance(camera, Camera):
            do = "make one FrozenView for each camera"
            raise InvalidValueError.of(
                "camera", "one Camera", type(camera).__name__, do
            )
        self.camera = camera
        self._shape = (camera.height, camera.width, 3)
        self._pairs, self._constant, self._alpha, self.nbytes = self._freeze(
            max_bytes, held
        )

    @property
    def megabytes(self) -> float:
        """`nbytes` in millions of bytes."""
        return self.nbytes / 1e6

    def __call__(self, sh: Tensor) -> Tensor:
        """The image with these colours."""
        if (
            not isinstance(sh, Tensor)
            or sh.ndim != 3
            or sh.shape[::2] != (len(self.rows), 3)
        ):
            got = tuple(sh.shape) if isinstance(sh, Tensor) else type(sh).__name__
            do = "pass the SH of the Gaussians in `rows`, in that order"
            raise InvalidValueError.of("sh", f"shape ({len(self.rows)}, K, 3)", got, do)
        degree_of(sh.shape[1])
        if sh.device != self._device:
            raise InvalidValueError.of(
                "sh", f"device {self._device}", sh.device, "move it with .to(device)"
            )
        _make_current(self.variant)
        picture: Tensor = _Step.apply(sh.to(torch.float32), self)
        if not math.isfinite(picture.detach().sum().item()) and not bool(
            picture.detach().isfinite().all()
        ):
            do = (
                "look at the last update of the parameters: a step may have been too"
                " long"
            )
            raise InvalidValueError.of(
                "sh", "numbers that make a finite image", "others", do
            )
        if self.settings.linear:
            picture = tensor_to_linear(picture)
        if self.settings.alpha:
            return torch.cat([picture, self._alpha[..., None]], dim=2)
        return picture

    def _freeze(self, max_bytes: int, held: int) -> tuple[Any, Tensor, Tensor, int]:
        """The weights (None where nothing free is visible), the constant part of the
        image, its alpha, `nbytes`.
        """
        settings = self.settings
        hole = Pinhole(
            camera=self.camera, near=settings.near, antialiased=settings.antialiased
        )
        arrays = tuple(aligned(mi.Float(tensor.flatten())) for tensor in self._kept)
        picture = rasterize(layouts.TENSORS, arrays, hole, settings.background)
        towards = self._kept[0][self.rows].double() - self.camera.position.to(
            self._device, torch.float64
        )
        directions = torch.nn.functional.normalize(towards, dim=1).to(torch.float32)
        free = mi.UInt32(self.rows.to(torch.int32).contiguous())
        towards = mi.Float(directions.flatten())
        pairs, nbytes = freeze_pairs(
            picture, free, towards, max_bytes=max_bytes, held=held
        )
        constant = picture.colour.torch().reshape(self._shape)
        alpha = picture.opacity.torch().reshape(self._shape[:2])
        return pairs, constant, alpha.clone(), nbytes


def give_memory_back() -> None:
    """Return what Dr.Jit holds of views that are gone to the system."""
    dr.flush_malloc_cache()


class _Step(torch.autograd.Function):
    """Image of SH, and gradient of SH, by the two frozen stages."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor, view: FrozenView) -> Tensor:
        ctx.view = view
        ctx.shape = sh.shape
        if view._pairs is None:
            return view._constant.clone()
        picture, ctx.colours = picture_of(
            view._pairs, sh.shape[1], mi.Float(sh.detach().flatten())
        )
        made: Tensor = picture.torch()
        return made.reshape(view._shape)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        view = ctx.view
        if view._pairs is None:
            return grad.new_zeros(ctx.shape), None
        _make_current(view.variant)
        grad_colours = gradient_of(
            view._pairs, ctx.shape[1], ctx.colours, mi.Float(grad.detach().flatten())
        )
        return grad_colours.torch().reshape(ctx.shape), None


def _make_current(name: str) -> None:
    """`variant.use`, without its look at the disk where there is nothing to do."""
    if mi.variant() != name:
        variant.use(name)


def _indices(rows: Tensor | slice | None, count: int) -> Tensor:
    """Rows of a scene of `count` Gaussians as indices from 0."""
    if rows is None or isinstance(rows, slice):
        return torch.arange(count)[slice(None) if rows is None else rows]
    if not isinstance(rows, Tensor):
        raise InvalidValueError.of(
            "rows", "a tensor or a slice", type(rows).__name__, "use torch.as_tensor"
        )
    check_rows(rows, count)
    if rows.dtype == torch.bool:
        indices = rows.nonzero().flatten()
    else:
        indices = rows.long() % max(count, 1)
    different = int(torch.bincount(indices, minlength=1).clamp(max=1).sum())
    if different != len(indices):
        got = f"{len(indices) - different} that are there before"
        raise InvalidValueError.of(
            "rows", "each Gaussian once", got, "call rows.unique()"
        )
    return indices
