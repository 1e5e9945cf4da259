"""Which pictures come from a `FrozenView` unasked: those from fixed cameras of a scene in which only colours change."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from torch import Tensor

from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import MiSplatError
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.frozen_view import FrozenView

MAX_BYTES = 2 << 30
"""What all views of one call of `freeze_views` may take together where nothing else is said."""

MIN_PICTURES = 3
"""Pictures with a gradient from one camera from which a view pays, even where everything is free: making it takes about
as long as one by a `Renderer`."""


def freeze_views(
    scene: GaussianScene,
    cameras: Iterable[Camera],
    *,
    render: RenderFn,
    pictures: int,
    rows: Tensor | None = None,
    max_bytes: int = MAX_BYTES,
) -> dict[Camera, FrozenView]:
    """A view for each camera from which it pays, as far as the memory reaches; `render` is there for all others.

    The pictures are those of `render` but for rounding. Which cameras have a view depends on the arguments alone, so
    that a run that was interrupted goes on with the same pictures to the bit.

    Args:
        scene: The splat.
        cameras: In the order in which they have a view; the first one that does not fit is the end.
        render: What pictures are made with otherwise. Of anything but a `Renderer` with the method "tile" and without
            screen gradients it is not known what it does, and there are no views.
        pictures: How many with a gradient each camera shall take; under `MIN_PICTURES` there are no views.
        rows: The Gaussians whose colours may change, see `FrozenView`; all if None.
        max_bytes: Upper bound of the memory of all views.
    """
    from mi_splat.frozen_view import FrozenView  # here, so that importing an attack does not import Mitsuba
    from mi_splat.rendering import Renderer

    views: dict[Camera, FrozenView] = {}
    if type(render) is not Renderer or render.settings.method != "tile" or render.screen_gradients is not None:
        return views
    if pictures < MIN_PICTURES:
        return views
    first: FrozenView | None = None
    for camera in dict.fromkeys(cameras):
        left = max_bytes - sum(view.nbytes for view in views.values())
        try:
            if first is None:
                view = first = FrozenView(scene, camera, settings=render.settings, rows=rows, max_bytes=left)
            else:
                view = first.at(camera, max_bytes=left)
        except MiSplatError:  # it does not fit; what else is wrong `render` says
            break
        views[camera] = view
    return views
