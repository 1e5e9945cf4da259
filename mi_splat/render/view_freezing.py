"""Which images come from a `FrozenView` unasked: those from fixed cameras of a scene
in which only colours change.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.errors import MiSplatError
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.render.frozen_view import FrozenView

MAX_BYTES = 2 << 30  # of all views together
KEPT_BYTES = 192 << 20
"""What views from changing cameras may take: those that validate a search, and a step's
own; a few MB each.
"""
MIN_PICTURES = 3
"""Images with a gradient from one camera from which a view pays, even where
everything is free: making it takes about as long as one by a `Renderer`.
"""


def freeze_views(
    scene: GaussianScene,
    cameras: Iterable[Camera],
    *,
    render: RenderFn,
    pictures: int,
    rows: Tensor | None = None,
    max_bytes: int = MAX_BYTES,
) -> dict[Camera, FrozenView]:
    """A view for each camera from which it pays, as far as the memory reaches; `render`
    is there for all others.
    """
    views: dict[Camera, FrozenView] = {}
    if pictures < MIN_PICTURES:
        return views
    for camera in dict.fromkeys(cameras):
        left = max_bytes - sum(view.nbytes for view in views.values())
        view = _view(
            scene,
            camera,
            next(iter(views.values()), None),
            render=render,
            rows=rows,
            max_bytes=left,
        )
        if view is None:
            break
        views[camera] = view
    return views


class RecentViews:
    """Views of one scene from cameras that come as they like: made when they are asked
    for, those used most kept.

    All images come from such views, whether they are kept or made again, so that memory
    decides nothing but time.
    """

    def __init__(
        self,
        scene: GaussianScene,
        *,
        render: RenderFn,
        rows: Tensor | None = None,
        max_bytes: int = MAX_BYTES,
        kept_bytes: int | None = None,
    ) -> None:
        self._scene = scene
        self._render = render
        self._rows = rows
        self._max_bytes = max_bytes
        self._kept_bytes = affordable_bytes() if kept_bytes is None else kept_bytes
        self._first: FrozenView | None = None
        self._kept: dict[Camera, FrozenView] = {}
        self._uses: Counter[Camera] = Counter()

    @property
    def nbytes(self) -> int:
        """What the views that are kept take."""
        return sum(view.nbytes for view in self._kept.values())

    def get(self, camera: Camera) -> FrozenView | None:
        """The view from a camera; None where there is none, so that images are those
        of `render`.
        """
        self._uses[camera] += 1
        view = self._kept.pop(camera, None) or _view(
            self._scene,
            camera,
            self._first,
            render=self._render,
            rows=self._rows,
            max_bytes=self._max_bytes,
        )
        if view is None:
            return None
        self._first = self._first or view
        self._make_room(view.nbytes)
        self._kept[camera] = view  # as the last one
        return view

    def clear(self) -> None:
        """Drop all views, and give their memory back; they are made again where they
        are asked for.
        """
        if self._first is None:
            return
        from mi_splat.render.frozen_view import give_memory_back

        self._first = None
        self._kept.clear()
        give_memory_back()

    def _make_room(self, wanted: int) -> None:
        """Drop views until there is room for another: of those used least, the one that
        was used longest ago.
        """
        while self._kept and self.nbytes + wanted > self._kept_bytes:
            del self._kept[min(self._kept, key=self._uses.__getitem__)]


def affordable_bytes(most: int = KEPT_BYTES) -> int:
    """What views may take that are made again where they are dropped: `most`, and less
    where memory is short.
    """
    return min(most, _available_bytes() // 8)


def _available_bytes() -> int:
    """Memory that programs may still take, as far as the system says."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        (line,) = (line for line in lines if line.startswith("MemAvailable:"))
        return int(line.split()[1]) << 10
    except (OSError, ValueError, IndexError):
        return 8 * KEPT_BYTES


def _view(
    scene: GaussianScene,
    camera: Camera,
    first: FrozenView | None,
    *,
    render: RenderFn,
    rows: Tensor | None,
    max_bytes: int,
) -> FrozenView | None:
    """A view like `first`, if there is one before; None where it does not fit, or
    `render` is one that is not known.
    """
    # here, so that importing an attack does not import Mitsuba
    from mi_splat.render.frozen_view import FrozenView
    from mi_splat.render.renderer import Renderer

    if (
        type(render) is not Renderer
        or render.settings.method != "tile"
        or render.screen_gradients is not None
    ):
        return None
    try:
        if first is not None:
            return first.at(camera, max_bytes=max_bytes)
        return FrozenView(
            scene, camera, settings=render.settings, rows=rows, max_bytes=max_bytes
        )
    except MiSplatError:  # it does not fit; what else is wrong `render` says
        return None
