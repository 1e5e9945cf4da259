"""What shows a look to a human: the two cameras that prove it, and the Gaussians that carry it."""

from __future__ import annotations

import torch
from torch import Tensor

from mi_splat.audit.surfaces import Elements, Sight
from mi_splat.audit.switches import angles_between
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc

_PIECES = 800
_BINS = 128


def pair_of(pieces: Elements, view: Sight, score: Tensor, shown: Tensor) -> tuple[int, int, float] | None:
    """The two cameras between which the surface that both see changes most, near each other if possible.

    Args:
        pieces: The surface.
        view: Its cameras.
        score: (E,) of each piece.
        shown: (K,) bool, the cameras that see the look.

    Returns:
        The number of a camera inside, that of one outside, and the mean change (sRGB); None if no two share a surface.
    """
    rows = score.argsort(descending=True)[:_PIECES]
    rows = rows[score[rows] > 0]
    seen, colours = pieces.moments[rows, :, 0] * score[rows, None], pieces.moments[rows, :, 1:4]
    inside, outside = shown.nonzero()[:, 0], (~shown).nonzero()[:, 0]
    if not len(rows) or not len(inside) or not len(outside):
        return None
    weight, change = torch.zeros(len(inside), len(outside)), torch.zeros(len(inside), len(outside))
    for number, camera in enumerate(inside.tolist()):
        both = (seen[:, camera, None] > 0) * seen[:, outside]
        gap = (colours[:, outside] - colours[:, camera, None]).abs().mean(-1)
        weight[number], change[number] = both.sum(0), (both * gap).sum(0)
    near = (angles_between(view.directions[inside], view.directions[outside]) / 2).deg2rad().cos()
    value = change * near
    best = int(value.argmax())
    first, second = divmod(best, len(outside))
    if not weight[first, second] > 0:
        return None
    return int(inside[first]), int(outside[second]), float(change[first, second] / weight[first, second])


def heat_of(scene: GaussianScene, pieces: Elements, view: Sight, score: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """How much of each score each Gaussian makes up: sums over the pixels of some cameras.

    A picture is linear in the colours, so the derivative by a Gaussian's colour is the sum of its weights.

    Args:
        scene: N Gaussians.
        pieces: The surface.
        view: Its cameras.
        score: (E,) of each piece.
        near: Near plane of the pictures.

    Returns:
        (N,) sum of weight times score, and (N,) sum of weights, both over pixels that show judged surface.
    """
    render = Renderer(RenderSettings(near=near))
    geometry, count = scene.tensors()[:4], len(scene)
    step = float(colour_to_dc(torch.tensor(1.0)) - colour_to_dc(torch.tensor(0.0)))
    value = torch.cat([torch.stack([score, torch.ones(len(score))], 1), torch.zeros(1, 2)])[pieces.of_seen]
    total, weight = torch.zeros(count), torch.zeros(count)
    for number, (pixels, seen) in view.pixels.items():
        camera = view.cameras[number]
        wanted = torch.zeros(camera.height * camera.width, 2)
        wanted[pixels] = value[seen]
        wanted = wanted.reshape(camera.height, camera.width, 2)
        sh = torch.zeros(count, 1, 3, requires_grad=True)
        with torch.enable_grad():
            picture = render(GaussianScene.unchecked(*geometry, sh), camera)
            (gradient,) = torch.autograd.grad((picture[..., :2] * wanted).sum(), sh)
        total += gradient[:, 0, 0] * step
        weight += gradient[:, 0, 1] * step
    return total, weight


def split_of(values: Tensor) -> float:
    """The number that best parts values into two groups (Otsu 1979).

    Args:
        values: (M,) at least 0.
    """
    top = float(values.max()) if len(values) else 0.0
    if not top > 0:
        return 0.0
    counts = torch.histc(values, _BINS, 0.0, top).double()
    middles = (torch.arange(_BINS, dtype=torch.float64) + 0.5) * top / _BINS
    low, sums = counts.cumsum(0), (counts * middles).cumsum(0)
    high = counts.sum() - low
    gap = sums / low.clamp(min=1) - (sums[-1] - sums) / high.clamp(min=1)
    return float(((low * high * gap.square()).argmax() + 1) * top / _BINS)
