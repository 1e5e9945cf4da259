"""The image of a 3D Gaussian splat by its definition: float64, NumPy alone, one loop
over Gaussians.

It is slow and obvious, a reference for tests of renderers: `render` is the rasterised
image of 3D Gaussian Splatting (Kerbl et al. 2023, with the projection of Zwicker et al.
2001), `render_rays` the one that evaluates each Gaussian where it is densest along a
ray, `gradients` the derivatives of the first. `Convention` names the choices on which
renderers differ; its defaults are those of the 3DGS code.

Splats are any objects with `means` (N, 3), `scales` (N, 3), `rotations` (N, 4) as w, x,
y, z, `opacities` (N,) and `sh` (N, K, 3), arrays or CPU tensors, as values and not as
logarithms or logits; `Splat` is one, and so is `GaussianScene`. Cameras have `to_world`
(4, 4) from x right, y down, z forward, `fx`, `fy`, `cx`, `cy` in pixels, `width` and
`height`; `PinholeCamera` is one, and so is `mi_splat.Camera`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]
_NAMES = ("means", "scales", "rotations", "opacities", "sh")
_STEP = 1e-30
"""Step of a derivative in the imaginary direction, which loses no digits (Squire and
Trapp 1998).
"""


class Splat(NamedTuple):
    """N Gaussians, with K SH coefficients of each colour channel."""

    means: Array  # (N, 3)
    scales: Array  # (N, 3) standard deviations
    rotations: Array  # (N, 4) quaternions w, x, y, z of any length
    opacities: Array  # (N,)
    sh: Array  # (N, K, 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PinholeCamera:
    """A camera of `width` x `height` pixels."""

    to_world: Array  # (4, 4) from x right, y down, z forward
    fx: float  # pixels
    fy: float
    cx: float
    cy: float
    width: int
    height: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Convention:
    """What renderers do differently; the defaults define the image of 3DGS."""

    near: float = 0.2  # Gaussians at a smaller depth are left out
    # equal depths keep the order of the file
    order: Literal["depth", "distance", "file", "reversed"] = "depth"
    # of the depth between the nearest and the farthest Gaussian; 0 is all of float32
    depth_bits: int = 0
    low_pass: float = 0.3  # pixels^2, added to the variances of the projected Gaussian
    # opacity lowered by what the low-pass filter adds to the area (antialiased, "mip")
    compensated: bool = False
    # of the half field of view, for the Jacobian alone; inf is none
    tangent_limit: float = 1.3
    min_alpha: float = 1 / 255  # smaller ones are left out
    cutoff: float = math.inf  # standard deviations at which a Gaussian ends
    # exp(-m / 2), exp(-m), or exp(-m / 2) lowered to reach 0 at sqrt(8) deviations
    falloff: Literal["half", "whole", "to 0 at sqrt(8)"] = "half"
    min_variance: float = 0.0  # pixels^2; Gaussians with smaller ones only are left out
    # pixels^2 by which the variances along the axes of an ellipse differ at least
    min_spread: float = 0.0
    # of the shorter side of the image, for sqrt(8) standard deviations of a Gaussian
    max_reach: float = math.inf
    # pixels on each side of a tile; 0 is none. A Gaussian is drawn in the tiles that
    # touch the square of three times its largest deviation, rounded up.
    tile: int = 0
    max_alpha: float = 0.99
    stop: float = 1e-4  # transmittance below which a pixel takes no further Gaussian
    pixel_centre: float = 0.5  # where the first pixel is sampled
    unit_rotations: bool = True  # quaternions are divided by their length
    sh_degree: int = 3  # higher bands are left out
    towards: Literal["gaussian", "camera", "camera's frame", "optical axis"] = (
        "gaussian"
    )
    clamp: Literal["below 0", "outside 0 to 1", "none"] = "below 0"  # of colours


DEFAULT = Convention()


class Image(NamedTuple):
    """What one camera sees."""

    image: Array  # (H, W, 3) in the colour space of the file, sRGB
    alpha: Array  # (H, W)
    depth: Array  # (H, W) mean of the blended depths; 0 where there is none
    # (H, W) depth at which half of the light is taken; 0 where it is not
    median_depth: Array


class Projected(NamedTuple):
    """Gaussians in the image."""

    depth: Array  # (N,)
    centre: Array  # (N, 2) pixels
    conic: Array  # (N, 2, 2) inverse covariance
    opacity: Array  # (N,)
    colour: Array  # (N, 3)
    distance: Array  # (N,) from the camera
    basis: Array  # (N, K) of the spherical harmonics


def sh_basis(directions: Array, count: int) -> Array:
    """(N, count) real spherical harmonics at unit vectors (N, 3), in the order and with
    the signs of 3DGS.
    """
    x, y, z = directions.T
    terms = [np.full_like(x, 0.28209479177387814)]
    terms += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    terms += [
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    ]
    terms += [
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    return np.stack(terms[:count], axis=1)


def rotation_matrices(quaternions: Array, *, unit: bool = False) -> Array:
    """(N, 3, 3) rotations of quaternions (N, 4) of any length, or of length 1."""
    w, x, y, z = (quaternions if unit else quaternions / _norm(quaternions)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def project(splat: Any, camera: Any, convention: Convention = DEFAULT) -> Projected:
    """Every Gaussian in the image, also those behind the camera; complex values are
    taken as they are.
    """
    means, scales, rotations, opacity, sh = _arrays(splat)
    pose = _pose(camera)
    offset = means - pose[:3, 3]
    local = offset @ pose[:3, :3]
    z = local[:, 2]
    tangents = local[:, :2] / z[:, None]
    extent = np.array([camera.width / camera.fx, camera.height / camera.fy])
    limit = np.minimum(0.5 * convention.tangent_limit * extent, 1e30)
    near_axis = np.where(
        np.abs(tangents.real) <= limit, tangents, np.sign(tangents.real) * limit
    )
    # Zwicker et al. 2001, equation 29
    jacobian = np.zeros((len(means), 2, 3), dtype=local.dtype)
    jacobian[:, 0, 0], jacobian[:, 1, 1] = camera.fx / z, camera.fy / z
    jacobian[:, :, 2] = -np.array([camera.fx, camera.fy]) * near_axis / z[:, None]
    turned = pose[:3, :3].T @ rotation_matrices(
        rotations, unit=not convention.unit_rotations
    )
    factor = jacobian @ turned * scales[:, None, :]
    covariance = factor @ factor.transpose(0, 2, 1)
    blurred = covariance + convention.low_pass * np.eye(2)
    if convention.min_spread or convention.max_reach < math.inf:
        blurred = _along_axes(blurred, camera, convention)
    (a, b), (_, c) = blurred.transpose(1, 2, 0)
    area = a * c - b * b
    conic = np.moveaxis(np.array([[c, -b], [-b, a]]) / area, 2, 0)
    if convention.compensated:
        (p, q), (_, r) = covariance.transpose(1, 2, 0)
        ratio = (p * r - q * q) / area
        opacity = opacity * np.sqrt(np.where(ratio.real > 0, ratio, 0))
    centre = tangents * np.array([camera.fx, camera.fy]) + np.array(
        [camera.cx, camera.cy]
    )
    count = min(sh.shape[1], (convention.sh_degree + 1) ** 2)
    basis = sh_basis(_sh_directions(offset, camera, convention), count)
    colour = _clamped(0.5 + np.einsum("nk,nkc->nc", basis, sh[:, :count]), convention)
    return Projected(z, centre, conic, opacity, colour, _norm(offset)[:, 0], basis)


@np.errstate(divide="ignore", invalid="ignore")
def _along_axes(covariance: Array, camera: Any, convention: Convention) -> Array:
    """Covariances (N, 2, 2) as viewers make them that draw an ellipse by its axes."""
    (a, b), (_, c) = covariance.transpose(1, 2, 0)
    middle = 0.5 * (a + c)
    half = np.sqrt(np.maximum(middle**2 - (a * c - b * b), 0.0))
    spread = np.maximum(half, 0.5 * convention.min_spread)
    longest = convention.max_reach * min(camera.width, camera.height)
    largest = longest**2 / 8
    variances = np.minimum([middle + spread, middle - spread], largest)
    variances[variances <= 0] = np.nan  # not drawn
    first = np.stack([b, middle + spread - a])
    length = np.linalg.norm(first, axis=0)
    x, y = np.where(length > 1e-6 * middle, first / length, [[1.0], [0.0]])
    axes = np.array([[x, y], [y, -x]])  # rows are axes
    whole: Array = np.einsum("in,ijn,ikn->njk", variances, axes, axes)
    return whole


class Layer(NamedTuple):
    """What one Gaussian does to the pixels of a box; it does nothing to the others."""

    number: int  # of the Gaussian
    box: tuple[slice, slice]  # rows and columns among the pixels, (h, w) of them
    alpha: Array  # (h, w)
    weight: Array  # (h, w)
    behind: Array  # (h, w) transmittance behind it


class Pixels(NamedTuple):
    """The pixels that are computed: every one of these rows in each of these
    columns.
    """

    rows: Array  # (H,)
    columns: Array  # (W,)


def every_pixel(camera: Any) -> Pixels:
    """All pixels of a camera."""
    return Pixels(np.arange(camera.height), np.arange(camera.width))


def blend(
    projected: Projected,
    camera: Any,
    convention: Convention = DEFAULT,
    pixels: Pixels | None = None,
) -> Iterator[Layer]:
    """Gaussians front to back, each in the box outside which its alpha is left out."""
    seen = every_pixel(camera) if pixels is None else pixels
    ys = seen.rows + convention.pixel_centre
    xs = seen.columns + convention.pixel_centre
    left = np.ones((len(ys), len(xs)))
    stopped = np.zeros(left.shape, dtype=bool)
    reach = _reach(projected, convention)
    deviation = _largest_deviation(projected.conic)
    for i in _front_to_back(projected, convention):
        if projected.depth[i] < convention.near:
            continue
        if deviation[i] ** 2 < convention.min_variance:
            continue
        box = _box(xs, ys, projected.centre[i], reach[i])
        if convention.tile:
            box = _tiles(seen, projected.centre[i], deviation[i], convention.tile, box)
        x = xs[box[1]] - projected.centre[i, 0]
        y = ys[box[0]][:, None] - projected.centre[i, 1]
        conic = projected.conic[i]
        squared = (
            (conic[0, 0] * x) * x + (2 * conic[0, 1] * x) * y + conic[1, 1] * y * y
        )
        alpha = np.minimum(
            convention.max_alpha, projected.opacity[i] * _falloff(squared, convention)
        )
        before = left[box]
        behind = before * (1 - alpha)
        drawn = (alpha >= convention.min_alpha) & ~stopped[box]
        if convention.cutoff < math.inf:
            drawn &= squared <= convention.cutoff**2
        ended = drawn & (behind < convention.stop)
        stopped[box] |= ended
        drawn &= ~ended
        alpha = np.where(drawn, alpha, 0.0)
        weight = alpha * before
        left[box] = np.where(drawn, behind, before)
        yield Layer(int(i), box, alpha, weight, left[box].copy())


def _front_to_back(projected: Projected, convention: Convention) -> Array:
    # A renderer of float32 splats has float32 depths, so these decide which of two
    # Gaussians is in front.
    depth = projected.depth.astype(np.float32)
    if convention.order == "file":
        return np.arange(len(depth))
    if convention.order == "distance":
        depth = projected.distance.astype(np.float32)
    if convention.order == "reversed":
        depth = -depth
    if convention.depth_bits:
        # Viewers spread their keys over the Gaussians that they draw.
        drawn = depth[projected.depth >= convention.near]
        steps = 2**convention.depth_bits - 1
        if len(drawn) and np.ptp(drawn) > 0:
            depth = np.floor((depth - drawn.min()) / np.ptp(drawn) * steps)
    return np.argsort(depth, kind="stable")


def _falloff(squared: Array, convention: Convention) -> Array:
    if convention.falloff == "whole":
        return np.exp(-squared)
    value = np.exp(-0.5 * squared)
    if convention.falloff == "half":
        return value
    end = math.exp(-4.0)
    return np.maximum(0.0, (value - end) / (1 - end))


@np.errstate(divide="ignore", invalid="ignore")
def _reach(projected: Projected, convention: Convention) -> Array:
    """(N, 2) how far from its centre a Gaussian may be drawn along x and y, pixels;
    infinite where its covariance is none.
    """
    conic = projected.conic
    least = max(convention.min_alpha, 1e-300)
    ratio = np.maximum(projected.opacity / least, 1.0)
    squared = np.minimum(2 * np.log(ratio), convention.cutoff**2)
    determinant = conic[:, 0, 0] * conic[:, 1, 1] - conic[:, 0, 1] * conic[:, 1, 0]
    variances = conic[:, [1, 0], [1, 0]] / determinant[:, None]
    reach = np.sqrt(squared[:, None] * variances) + 1.0
    proper = (determinant > 0) & (variances > 0).all(axis=1)
    return np.where(proper[:, None] & np.isfinite(reach), reach, np.inf)


@np.errstate(divide="ignore", invalid="ignore")
def _largest_deviation(conic: Array) -> Array:
    """(N,) largest standard deviation of Gaussians in the image, pixels."""
    middle = 0.5 * (conic[:, 0, 0] + conic[:, 1, 1])
    spread = np.hypot(0.5 * (conic[:, 0, 0] - conic[:, 1, 1]), conic[:, 0, 1])
    deviation = 1 / np.sqrt(middle - spread)
    return np.where(np.isfinite(deviation), deviation, np.inf)


def _box(xs: Array, ys: Array, centre: Array, reach: Array) -> tuple[slice, slice]:
    columns = _run(np.abs(xs - centre[0]) <= reach[0])
    return _run(np.abs(ys - centre[1]) <= reach[1]), columns


def _run(inside: Array) -> slice:
    """From the first to the last that is inside."""
    found = np.flatnonzero(inside)
    return slice(found[0], found[-1] + 1) if len(found) else slice(0, 0)


def _tiles(
    pixels: Pixels,
    centre: Array,
    deviation: float,
    tile: int,
    box: tuple[slice, slice],
) -> tuple[slice, slice]:
    """The part of a box in the tiles that a Gaussian's square touches."""
    if not math.isfinite(deviation):
        return box
    radius = math.ceil(3 * deviation)
    parts = []
    # Its pixels are counted from their centres.
    middle = centre[::-1] - 0.5
    for at, run, along in zip(middle, box, pixels, strict=True):
        first = math.floor((at - radius) / tile) * tile
        end = math.floor((at + radius + tile - 1) / tile) * tile
        inside = (along >= first) & (along < end)
        kept = np.zeros(len(along), dtype=bool)
        kept[run] = inside[run]
        parts.append(_run(kept))
    return parts[0], parts[1]


def render(
    splat: Any,
    camera: Any,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    convention: Convention = DEFAULT,
    pixels: Pixels | None = None,
) -> Image:
    """The rasterised image.

    Args:
        splat: Gaussians, see above.
        camera: Camera, see above.
        background: (3,) colour behind all Gaussians.
        convention: Choices of the renderer.
        pixels: Those that are computed; all by default.
    """
    projected = project(splat, camera, convention)
    seen = every_pixel(camera) if pixels is None else pixels
    shape = (len(seen.rows), len(seen.columns))
    image = np.zeros((*shape, 3))
    left = np.ones(shape)
    total = np.zeros(shape)
    summed = np.zeros(shape)
    median = np.zeros(shape)
    for layer in blend(projected, camera, convention, seen):
        z = projected.depth[layer.number]
        box = layer.box
        left[box] = layer.behind
        image[box] += layer.weight[..., None] * projected.colour[layer.number]
        total[box] += layer.weight
        summed[box] += z * layer.weight
        half = (median[box] == 0) & (layer.behind <= 0.5)
        median[box] = np.where(half, z, median[box])
    depth = np.where(total > 0, summed / np.where(total > 0, total, 1), 0)
    return Image(
        image + left[..., None] * np.asarray(background, dtype=np.float64),
        1 - left,
        depth,
        median,
    )


def gradients(
    splat: Any,
    camera: Any,
    on_image: Array,
    on_alpha: ArrayLike = 0.0,
    on_depth: ArrayLike = 0.0,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    convention: Convention = DEFAULT,
) -> Splat:
    """Derivatives of sum(on_image * image) + sum(on_alpha * alpha) + sum(on_depth *
    depth) by every attribute.

    These are the derivatives of a loss by what `render` gives: on_image (H, W, 3),
    on_alpha (H, W), and on_depth (H, W) by the mean depth. The other arguments are
    those of `render`.
    """
    projected = project(splat, camera, convention)
    by_projected = projected_gradients(
        projected,
        camera,
        on_image,
        on_alpha,
        on_depth,
        background=background,
        convention=convention,
    )
    return attribute_gradients(splat, camera, by_projected, convention)


class ProjectedGradients(NamedTuple):
    """Derivatives by the Gaussians in the image, shaped as those of `Projected`."""

    depth: Array
    centre: Array
    conic: Array
    opacity: Array
    colour: Array


def projected_gradients(
    projected: Projected,
    camera: Any,
    on_image: Array,
    on_alpha: ArrayLike = 0.0,
    on_depth: ArrayLike = 0.0,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    convention: Convention = DEFAULT,
    through_limit: bool = False,
) -> ProjectedGradients:
    """Derivatives by the Gaussians in the image, the first half of `gradients`.

    With `through_limit`, alphas at their largest value pass derivatives as if they
    were not limited, which is a mistake that renderers make. The other arguments are
    those of `gradients`.
    """
    on = ProjectedGradients(*(np.zeros(array.shape) for array in projected[:5]))
    layers = list(blend(projected, camera, convention))
    shape = on_image.shape[:2]
    total = np.zeros(shape)
    summed = np.zeros(shape)
    left = np.ones(shape)
    for layer in layers:
        total[layer.box] += layer.weight
        summed[layer.box] += layer.weight * projected.depth[layer.number]
        left[layer.box] = layer.behind
    total = np.where(total > 0, total, 1.0)
    mean_depth = summed / total
    on_depth = np.broadcast_to(np.asarray(on_depth) / total, shape)
    # what lies behind a Gaussian
    behind = left * (on_image @ np.asarray(background, dtype=np.float64) - on_alpha)
    ys, xs = np.mgrid[0 : camera.height, 0 : camera.width] + convention.pixel_centre
    for i, box, alpha, weight, left in reversed(layers):
        on.colour[i] = np.einsum("hw,hwc->c", weight, on_image[box])
        on.depth[i] = (weight * on_depth[box]).sum()
        deeper = projected.depth[i] - mean_depth[box]
        shown = on_image[box] @ projected.colour[i] + on_depth[box] * deeper
        on_alphas = np.where(alpha > 0, (left * shown - behind[box]) / (1 - alpha), 0.0)
        behind[box] += weight * shown
        if not through_limit:
            on_alphas = np.where(alpha < convention.max_alpha, on_alphas, 0.0)
        by_exponent = on_alphas * alpha
        offset = np.stack(
            [xs[box] - projected.centre[i, 0], ys[box] - projected.centre[i, 1]],
            axis=-1,
        )
        if projected.opacity[i]:
            on.opacity[i] = by_exponent.sum() / projected.opacity[i]
        on.conic[i] = -0.5 * np.einsum("hw,hwi,hwj->ij", by_exponent, offset, offset)
        moment = np.einsum("hw,hwi->i", by_exponent, offset)
        on.centre[i] = projected.conic[i] @ moment
    return on


def attribute_gradients(
    splat: Any, camera: Any, on: ProjectedGradients, convention: Convention = DEFAULT
) -> Splat:
    """Derivatives by every attribute from those by the Gaussians in the image, the
    second half of `gradients`.
    """
    projected = project(splat, camera, convention)
    values = Splat(*_arrays(splat))
    free = (projected.colour > 0) | (convention.clamp == "none")
    if convention.clamp == "outside 0 to 1":
        free &= projected.colour < 1
    by_colour = on.colour * free
    by_sh = np.zeros(values.sh.shape)
    by_sh[:, : projected.basis.shape[1]] = (
        projected.basis[..., None] * by_colour[:, None]
    )
    found = [by_sh]
    for name in ("opacities", "rotations", "scales", "means"):
        value = getattr(values, name)
        by = np.zeros(value.shape)
        for entry in range(math.prod(value.shape[1:])):
            moved = value.astype(np.complex128)
            moved.reshape(len(value), -1)[:, entry] += 1j * _STEP
            turned = project(values._replace(**{name: moved}), camera, convention)
            changes = [
                (weights * part.imag).reshape(len(value), -1).sum(1)
                for weights, part in zip(on, turned[:5], strict=True)
            ]
            by.reshape(len(value), -1)[:, entry] = np.sum(changes, axis=0) / _STEP
        found.insert(0, by)
    return Splat(*found)


def densest(splat: Any, origin: Array, directions: Array) -> tuple[Array, Array]:
    """(N, D) distances at which N Gaussians are densest along D rays, and their alphas
    there.
    """
    means, scales, rotations, opacities, _ = _arrays(splat)
    whitening = rotation_matrices(rotations).transpose(0, 2, 1) / scales[:, :, None]
    g = np.einsum("nij,dj->ndi", whitening, directions)
    h = np.einsum("nij,nj->ni", whitening, origin - means)[:, None]
    t = -(g * h).sum(-1) / (g * g).sum(-1)
    return t, opacities[:, None] * np.exp(-0.5 * ((h + g * t[..., None]) ** 2).sum(-1))


def pixel_rays(camera: Any, pixels: Pixels | None = None) -> tuple[Array, Array, Array]:
    """Origin (3,), unit directions (H W, 3) through pixel centres, and their lengths
    for each unit of depth (H W,).
    """
    seen = every_pixel(camera) if pixels is None else pixels
    ys, xs = np.meshgrid(seen.rows + 0.5, seen.columns + 0.5, indexing="ij")
    local = np.stack(
        [(xs - camera.cx) / camera.fx, (ys - camera.cy) / camera.fy, np.ones_like(xs)],
        -1,
    ).reshape(-1, 3)
    lengths = np.linalg.norm(local, axis=1)
    pose = _pose(camera)
    return pose[:3, 3], (local / lengths[:, None]) @ pose[:3, :3].T, lengths


def render_rays(
    splat: Any,
    camera: Any,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    near: float = 0.2,
    to_mean: bool = False,
    pixels: Pixels | None = None,
) -> tuple[Array, Array]:
    """The image (H, W, 3) of Gaussians evaluated and sorted where each is densest along
    a ray, and its alpha (H, W).

    Nothing is drawn before the depth `near`. With `to_mean` SH are evaluated in the
    direction of the mean, as when rasterising, and not of the ray. The other arguments
    are those of `render`.
    """
    seen = every_pixel(camera) if pixels is None else pixels
    origin, directions, lengths = pixel_rays(camera, seen)
    means, *_, sh = _arrays(splat)
    distances, alphas = densest(splat, origin, directions)
    drawn = (alphas >= DEFAULT.min_alpha) & (distances >= near * lengths)
    alphas = np.where(drawn, np.minimum(alphas, DEFAULT.max_alpha), 0.0)
    shown = drawn.any(axis=1)
    alphas = alphas[shown]
    distances = distances[shown]
    sh = sh[shown]
    offset = means[shown] - origin
    towards = offset / _norm(offset) if to_mean else directions
    basis = sh_basis(towards, sh.shape[1])
    colours = np.maximum(
        0.0, 0.5 + np.einsum("nk,nkc->nc" if to_mean else "dk,nkc->ndc", basis, sh)
    )
    colours = np.broadcast_to(
        colours[:, None] if to_mean else colours, (*alphas.shape, 3)
    )
    order = np.argsort(distances, axis=0, kind="stable")
    alphas = np.take_along_axis(alphas, order, 0)
    colours = np.take_along_axis(colours, order[..., None], 0)
    image = np.zeros((len(directions), 3))
    left = np.ones(len(directions))
    for alpha, colour in zip(alphas, colours, strict=True):
        image += (left * alpha)[:, None] * colour
        left = left * (1 - alpha)
        left[left < DEFAULT.stop] = 0.0
    image += left[:, None] * np.asarray(background, dtype=np.float64)
    shape = (len(seen.rows), len(seen.columns))
    return image.reshape(*shape, 3), 1 - left.reshape(shape)


def _arrays(splat: Any) -> list[Array]:
    values = (getattr(splat, name) for name in _NAMES)
    arrays = (
        np.asarray(value.detach() if hasattr(value, "detach") else value)
        for value in values
    )
    return [
        array if np.iscomplexobj(array) else array.astype(np.float64)
        for array in arrays
    ]


def _pose(camera: Any) -> Array:
    return np.asarray(camera.to_world, dtype=np.float64)


def _norm(vectors: Array) -> Array:
    """(N, 1) lengths, which may be complex."""
    lengths: Array = np.sqrt((vectors * vectors).sum(-1, keepdims=True))
    return lengths


def _sh_directions(offset: Array, camera: Any, convention: Convention) -> Array:
    if convention.towards == "optical axis":
        return np.broadcast_to(_pose(camera)[:3, 2].astype(offset.dtype), offset.shape)
    directions: Array = offset / _norm(offset)
    if convention.towards == "camera's frame":
        return directions @ _pose(camera)[:3, :3]
    if convention.towards == "gaussian":
        return directions
    return -directions


def _clamped(colour: Array, convention: Convention) -> Array:
    if convention.clamp == "none":
        return colour
    above = np.where(colour.real > 0, colour, 0)
    if convention.clamp == "below 0":
        return above
    return np.where(above.real < 1, above, 1)
