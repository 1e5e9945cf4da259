"""From a `Selection` to the mask of its Gaussians, and what is doubtful about it."""

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError
from mi_splat.scene import GaussianScene
from mi_splat.selection.clusters import clusters
from mi_splat.selection.config import Selection
from mi_splat.selection.masks import box_mask, load_mask, mask_of
from mi_splat.selection.visibility import pixel_weights

FEWEST = 10
"""A selection of fewer Gaussians is doubted."""
MOST = 0.95
"""A selection of a larger share of the scene is doubted."""
SEEN = 0.5
"""A pixel shows the object where this share of it is the object's."""
_AROUND = 1.5
"""How far around a click is looked, in halves of the picture's diagonal at its depth."""
_NAMED = 4
"""Cameras that are named at most."""


def select(
    scene: GaussianScene,
    selection: Selection,
    *,
    objects: Mapping[str, slice] | None = None,
    camera: Camera | None = None,
    render: RenderFn | None = None,
) -> Tensor:
    """The Gaussians of one object.

    Args:
        scene: The scene.
        selection: Which; of several selectors together, what all of them select.
        objects: Rows of the parts of a scene file, for `Selection.object`.
        camera: Whose picture is clicked on, for `Selection.click`.
        render: Makes that picture, for `Selection.click`.

    Returns:
        (N,) bool, at least one of them true.

    Raises:
        InvalidValueError: Nothing is selected, the selection does not fit the scene, or something that it needs is not
            given.
        SplatFileError: A mask file cannot be read.
    """
    if selection.is_empty:
        do = _HOW + (f"; parts: {', '.join(objects)}" if objects else "")
        raise InvalidValueError.of("selection", "which Gaussians are meant", "nothing", do).hinted(_FLAGS)
    mask = torch.ones(len(scene), dtype=torch.bool)
    if selection.object is not None:
        if selection.object not in (objects or {}):
            expected = f"one of {', '.join(objects)}" if objects else "no name, since the scene has no parts"
            raise InvalidValueError.of("object", expected, selection.object, _HOW).hinted(_FLAGS)
        part = torch.zeros_like(mask)
        part[(objects or {})[selection.object]] = True
        mask &= part
    if selection.box is not None:
        mask &= box_mask(scene, selection.box, selection.box_rotation)
    if selection.mask is not None:
        given = selection.mask
        mask &= load_mask(given, scene) if isinstance(given, Path) else mask_of(given, len(scene))
    if selection.cluster is not None:
        labels = _clusters(scene, selection)
        if selection.cluster > (count := len(labels.bincount())):
            raise InvalidValueError.of("cluster", f"1 to {count:,}", selection.cluster, "1 is the largest")
        mask &= labels == selection.cluster - 1
    if selection.click:
        mask &= _clicked(scene, selection, camera, render)
    if not bool(mask.any()):
        do = f"look at where it is in a picture of the scene; {_HOW}"
        raise InvalidValueError.of("selection", "at least one Gaussian", f"none of {len(scene):,}", do).hinted(_FLAGS)
    return mask


_HOW = "name a part (object), or say a box, a click, a cluster or a mask"
_FLAGS = "--object, --box, --click, --cluster or --mask"


def doubts(mask: Tensor, weights: Mapping[str, Tensor]) -> list[str]:
    """Reasons to look twice at a selection, in words."""
    count, total = int(mask.sum()), len(mask)
    texts = []
    if count < FEWEST:
        texts.append(f"the selection has {count} of {total:,} Gaussians, which is hardly an object")
    if count > MOST * total:
        texts.append(f"the selection has {count:,} of {total:,} Gaussians: nearly the whole scene, surroundings, too")
    if hidden := _hidden(weights):
        texts.append(f"the selection does not show {hidden}; something hides it, or it is outside the picture")
    return texts


def require_visible(weights: Mapping[str, Tensor]) -> None:
    """Raise unless an object shows from every camera."""
    if hidden := _hidden(weights):
        do = "leave these cameras out, or choose others"
        raise InvalidValueError.of("cameras", "views that show the selection", f"none {hidden}", do)


def _hidden(weights: Mapping[str, Tensor]) -> str:
    """From where an object does not show, in words; empty if it shows from everywhere."""
    hidden = {name: float(weight.max()) for name, weight in weights.items() if not bool((weight >= SEEN).any())}
    if not hidden:
        return ""
    names = ", ".join(list(hidden)[:_NAMED]) + (", ..." if len(hidden) > _NAMED else "")
    counts = f"{len(hidden)} of {len(weights)} cameras"
    return f"from {names} ({counts}; at most {max(hidden.values()):.0%} of any pixel is its)"


def _clusters(scene: GaussianScene, selection: Selection) -> Tensor:
    """The connected components as the selection counts them."""
    return clusters(
        scene, link_distance=selection.link_distance, link_colour=selection.link_colour, planes=selection.planes
    )


def _clicked(scene: GaussianScene, selection: Selection, camera: Camera | None, render: RenderFn | None) -> Tensor:
    """The components that make up most of the pixels that were clicked on.

    Only what is near the clicked point is looked at, by the measure of the picture: so the largest plane is the one
    that the object stands on, and not a floor or a wall far away.
    """
    if camera is None or render is None:
        raise InvalidValueError.of("click", "a camera and a renderer", "none", "say in whose picture")
    mask = torch.zeros(len(scene), dtype=torch.bool)
    means = scene.means.detach().cpu().double()
    for pixel in selection.pixels:
        weights = pixel_weights(scene, camera, pixel, render).cpu().double()
        point = means[int(weights.argmax())]
        shown = math.hypot(camera.width / camera.fx, camera.height / camera.fy) / 2  # half a diagonal at depth 1
        depth = float((point - camera.position).norm())
        near = ((means - point).norm(dim=1) <= _AROUND * shown * depth).nonzero()[:, 0]
        labels = _clusters(scene.select(near), selection)
        label = int(torch.bincount(labels, weights[near]).argmax())
        mask[near[labels == label]] = True
    return mask
