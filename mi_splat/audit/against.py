"""What changed between a splat and the file it was made from: which Gaussians, in what,
and by how much.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mi_splat.audit.objects import Target
from mi_splat.audit.viewpoints import SKY, near_of, views_around
from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.maths.neighbours import nearest_neighbours
from mi_splat.maths.quantiles import quantile
from mi_splat.maths.rotation import multiply
from mi_splat.maths.sh import colour_to_dc
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import resized
from mi_splat.scene import GaussianScene, check_scene

# Comparison with a clean file
# Distance within which a Gaussian is in its place, in the spacing of the clean
# splat,
_UNMOVED = 0.1
_PARTNER = 0.5  # and within which it may have a partner.
# Of the smaller splat that has to be in its place for one to be made from the
# other.
_SAME_SHARE = 0.5
_CANDIDATES = 8  # Neighbours among which a partner is looked for.
_SPACING = 3  # The neighbour whose distance is the spacing.
# Differences that files round away, of positions in the spacing.
_ROUNDING = 1e-5
# Times the median from which a difference is masked, where every Gaussian differs.
_MORE_CHANGED = 4.0
_CHANGED_MARGIN = 1.2  # Radius of what is looked at, by that of what changed.
_WORST_SIZE = 48  # Pixels of images that choose the worst cameras,
_WORST_OF = 30  # of which so many are tried.
_WORST_CAMERAS = 2  # That are shown,
_WORST_WIDTH = 384  # so wide.

_UNITS = {
    "position": "world units",
    "scale": "of its logarithm",
    "rotation": "degrees",
    "opacity": "of 1",
    "colour": "sRGB",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What became of one attribute, over the Gaussians that have a partner in the clean
    splat.
    """

    attribute: str
    unit: str  # of `median` and `most`
    count: int  # Gaussians in which it differs
    median: float  # median difference of these; 0 if there are none
    most: float  # largest difference


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Changes:
    """How a splat differs from the one it was made from."""

    changed: Tensor  # (N,) bool, Gaussians that differ from their partner, or have none
    # (N,) bool, the same; where every Gaussian differs, as after compression, those
    # that differ most
    mask: Tensor
    attributes: tuple[Change, ...]
    added: int  # Gaussians without a partner
    removed: int  # Gaussians of the clean splat without a partner
    # whether partners stand in the same row; else they are at the same place
    by_order: bool
    # from which both differ most, the worst first; none if no camera sees what changed
    cameras: tuple[Camera, ...]
    clean: GaussianScene

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {
            "gaussians": len(self.changed),
            "changed": int(self.changed.sum()),
            "masked": int(self.mask.sum()),
            "added": self.added,
            "removed": self.removed,
            "matched_by": "row" if self.by_order else "place",
            "attributes": [dataclasses.asdict(row) for row in self.attributes],
        }

    def in_words(self) -> list[str]:
        """What changed, in sentences."""
        if not bool(self.changed.any()) and not self.removed:
            return ["against the clean splat: nothing changed"]
        order = "in the same order" if self.by_order else "matched by their places"
        lines = [
            f"against the clean splat: {int(self.changed.sum()):,} of"
            f" {len(self.changed):,} Gaussians changed, {self.added:,} of them have no"
            f" counterpart; {self.removed:,} are missing; rows {order}"
        ]
        lines += [
            f"{row.attribute}: {row.count:,} changed, median {row.median:.3g}, most"
            f" {row.most:.3g} ({row.unit})"
            for row in self.attributes
            if row.count
        ]
        return lines


def changes(scene: GaussianScene, clean: GaussianScene) -> Changes:
    """Say how a splat differs from the one it was made from."""
    check_scene("scene", scene)
    check_scene("clean", clean)
    for what, item in (("scene", scene), ("--against", clean)):
        if not len(item):
            raise InvalidValueError.of(
                what, "a splat with Gaussians", "none", "pass the whole file"
            )
    scene, clean = (item.detach().to("cpu", torch.float32) for item in (scene, clean))
    degree = max(scene.degree, clean.degree)
    scene = scene.with_degree(degree)
    clean = clean.with_degree(degree)
    spacing = _spacing(clean)
    partner, by_order = _partners(scene, clean, spacing)
    matched = partner >= 0
    ours = _components(scene)
    theirs = _components(clean)
    changed = ~matched
    amount = torch.zeros(int(matched.sum()))
    rows = []
    for name in ours:
        values = _difference(name, ours[name][matched], theirs[name][partner[matched]])
        differs = values > (_ROUNDING * spacing if name == "position" else _ROUNDING)
        changed[matched] |= differs
        amount = torch.maximum(
            amount, values / {"position": spacing, "rotation": 57.3}.get(name, 1.0)
        )
        rows.append(_row(name, values[differs]))
    mask = changed.clone()
    if bool(changed[matched].all()) and len(amount):
        mask[matched] = amount > _MORE_CHANGED * amount.median()
    return Changes(
        changed=changed,
        mask=mask,
        attributes=tuple(rows),
        added=int((~matched).sum()),
        removed=len(clean) - len(torch.unique(partner[matched])),
        by_order=by_order,
        cameras=_worst(scene, clean, mask if bool(mask.any()) else None, partner),
        clean=clean,
    )


def _spacing(scene: GaussianScene) -> float:
    """Median distance of a Gaussian to its third neighbour, world units; that of its
    size where it has none.
    """
    distances, _ = nearest_neighbours(scene.means, _SPACING)
    if not distances.shape[1]:
        return float(scene.scales.max())
    return max(float(distances[:, -1].median()), 1e-12)


def _partners(
    scene: GaussianScene, clean: GaussianScene, spacing: float
) -> tuple[Tensor, bool]:
    """(N,) the row of the clean splat that each Gaussian came from, -1 if none; and
    whether it is the same row.
    """
    if len(scene) == len(clean):
        apart = (scene.means - clean.means).norm(dim=1)
        if float((apart < _UNMOVED * spacing).double().mean()) >= _SAME_SHARE:
            return torch.arange(len(scene)), True
    count = len(scene)
    distances, rows = nearest_neighbours(
        torch.cat([scene.means, clean.means]), _CANDIDATES
    )
    distances = distances[:count].float() / spacing
    rows = rows[:count] - count
    colours = (clean.sh[rows.clamp(min=0), 0] - scene.sh[:, None, 0]).abs().mean(-1)
    cost = (distances + colours).masked_fill(
        (rows < 0) | (distances > _PARTNER), math.inf
    )
    if not cost.shape[1]:
        cost = torch.full((count, 1), math.inf)
        rows = torch.zeros(count, 1, dtype=torch.int64)
    least, at = cost.min(1)
    partner = torch.where(least < math.inf, rows.gather(1, at[:, None])[:, 0], -1)
    unmoved = (least < math.inf) & (distances.gather(1, at[:, None])[:, 0] < _UNMOVED)
    share = float(unmoved.sum()) / min(count, len(clean))
    if share < _SAME_SHARE:
        expected = (
            "the splat that the other was made from, with most Gaussians in the same"
            " place"
        )
        do = "pass the file as it was before the edit, in the same units and axes"
        raise InvalidValueError.of(
            "--against", expected, f"{min(share, 1):.0%} of them there", do
        )
    # the best of several from one Gaussian keeps it, the others were added
    order = least.argsort(stable=True)
    first = torch.full((len(clean),), count).scatter_reduce_(
        0,
        partner[order].clamp(min=0),
        torch.where(partner[order] >= 0, torch.arange(count), count),
        "amin",
    )
    kept = torch.zeros(count, dtype=torch.bool)
    kept[order[first[first < count]]] = True
    return torch.where(kept, partner, -1), False


def _components(scene: GaussianScene) -> dict[str, Tensor]:
    """(N, C) values of each attribute."""
    values = {
        "position": scene.means,
        "scale": scene.scales.clamp(min=1e-12).log(),
        "rotation": (
            scene.rotations * torch.where(scene.rotations[:, :1] < 0, -1.0, 1.0)
        ),
        "opacity": scene.opacities[:, None],
        "colour": scene.sh[:, 0],
    }
    bands = range(1, scene.degree + 1)
    return values | {
        f"SH of degree {band}": scene.sh[:, band**2 : (band + 1) ** 2].flatten(1)
        for band in bands
    }


def _difference(attribute: str, ours: Tensor, clean: Tensor) -> Tensor:
    """(M,) difference of each Gaussian from its partner, in the attribute's unit."""
    if attribute == "position":
        apart: Tensor = (ours - clean).norm(dim=1)
        return apart
    if attribute == "rotation":
        turn = multiply(
            ours.double(), (clean * clean.new_tensor([1.0, -1.0, -1.0, -1.0])).double()
        )
        turn = turn / turn.norm(dim=1, keepdim=True).clamp(min=1e-12)
        degrees: Tensor = (
            2 * torch.atan2(turn[:, 1:].norm(dim=1), turn[:, 0].abs()).rad2deg()
        )
        return degrees.float()
    step = float(colour_to_dc(torch.tensor(1.0)) - colour_to_dc(torch.tensor(0.0)))
    return (ours - clean).abs().amax(1) / (step if attribute == "colour" else 1.0)


def _row(name: str, values: Tensor) -> Change:
    """One row of the table, of the differences that are any."""
    return Change(
        attribute=name,
        unit=_UNITS.get(name, "coefficient"),
        count=len(values),
        median=float(values.median()) if len(values) else 0.0,
        most=float(values.max()) if len(values) else 0.0,
    )


def _worst(
    scene: GaussianScene, clean: GaussianScene, mask: Tensor | None, partner: Tensor
) -> tuple[Camera, ...]:
    """The cameras around what changed from which both differ most."""
    lost = torch.ones(len(clean), dtype=torch.bool)
    lost[partner[partner >= 0]] = False
    points = torch.cat(
        [scene.means[mask] if mask is not None else scene.means[:0], clean.means[lost]]
    ).double()
    if not len(points):
        return ()
    centre = points.median(0).values
    size = max(
        quantile((points - centre).norm(dim=1), 0.9), float(scene.scales.median())
    )
    target = Target(
        rows=torch.arange(0),
        centre=centre,
        radius=_CHANGED_MARGIN * size,
        up=None,
    )
    cameras = views_around(target, _WORST_OF)
    render = Renderer(RenderSettings(near=near_of(target, cameras), background=SKY))
    with torch.no_grad():
        small = [resized(camera, (_WORST_SIZE, _WORST_SIZE)) for camera in cameras]
        gaps = [
            float(
                (render(scene, c).clamp(0, 1) - render(clean, c).clamp(0, 1))
                .square()
                .mean()
            )
            for c in small
        ]
    order = sorted(range(len(gaps)), key=lambda number: -gaps[number])
    return tuple(
        resized(cameras[number], (_WORST_WIDTH, _WORST_WIDTH))
        for number in order[:_WORST_CAMERAS]
        if gaps[number] > 0
    )
