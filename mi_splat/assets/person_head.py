"""A person's head, hair, caps and hands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets.implicit import Blob, Layer, chain, cone, ellipsoid
from mi_splat.assets.mesh import Floats, Mesh, transform
from mi_splat.assets.organic import Noise, body, mix, spot
from mi_splat.assets.person_body import Appearance, Limb


def _head_layers(appearance: Appearance) -> list[Layer]:
    """Head, hair and cap about the middle of the head; the face looks along +x."""
    head = [
        ellipsoid((-0.008, 0, 0.025), (0.096, 0.074, 0.084)),
        ellipsoid((0.024, 0, -0.042), (0.066, 0.058 if appearance.feminine else 0.062, 0.078)),
        ellipsoid((0.064, 0, -0.098), (0.022, 0.026, 0.020)),
        cone((0.090, 0, 0.004), (0.106, 0, -0.030), (0.008, 0.014)),
        cone((0.080, -0.030, 0.020), (0.080, 0.030, 0.020), (0.012, 0.012)),
        cone((0.088, -0.014, -0.066), (0.088, 0.014, -0.066), (0.008, 0.008)),
        cone((-0.012, 0, -0.08), (-0.025, 0, -0.17), (0.050, 0.054)),
    ]
    head += [ellipsoid((-0.004, s * 0.076, -0.012), (0.020, 0.013, 0.032)) for s in (1, -1)]
    hair = _hair(appearance.style)
    layers = [Layer(tuple(head), 0.02), Layer(tuple(hair), 0.025)]
    crown = ellipsoid((-0.012, 0, 0.062), (0.106, 0.092, 0.074))
    if appearance.cap == "cap":
        layers.append(
            Layer((crown, cone((0.07, 0, 0.045), (0.135, 0, 0.033), (0.013, 0.012), flat=(0, 4.2, 0))), 0.015)
        )
    elif appearance.cap == "beanie":
        layers.append(
            Layer(
                (crown, ellipsoid((-0.02, 0, 0.078), (0.098, 0.086, 0.075)), ellipsoid((-0.03, 0, 0.158), (0.03,) * 3)),
                0.02,
            )
        )
    return layers


def _hair(style: str) -> list[Blob]:
    """Hair about the middle of the head."""
    back = [ellipsoid((-0.020, 0, 0.038), (0.096, 0.083, 0.084)), ellipsoid((-0.045, 0, 0), (0.070, 0.080, 0.080))]
    if style == "crop":
        return [ellipsoid((-0.020, 0, 0.036), (0.094, 0.079, 0.081)), ellipsoid((-0.04, 0, 0), (0.070, 0.077, 0.07))]
    if style == "bald":
        return [ellipsoid((-0.048, 0, -0.018), (0.062, 0.078, 0.035))]
    if style == "curly":
        return [ellipsoid((-0.03, 0, 0.045), (0.118, 0.118, 0.105)), ellipsoid((-0.055, 0, -0.01), (0.08, 0.10, 0.09))]
    if style == "bun":
        return [*back, ellipsoid((-0.118, 0, 0.065), (0.045, 0.048, 0.045))]
    if style == "tail":
        return back + chain([(-0.10, 0, 0.06), (-0.145, 0, 0.02), (-0.15, 0, -0.16)], [0.03, 0.035, 0.016])
    if style == "long":
        fall = [(-0.06, 0, 0.0), (-0.075, 0, -0.12), (-0.08, 0, -0.22)]
        back += chain(fall, [0.07, 0.062, 0.04], flat=(0, 0.4, 0))
        for s in (1, -1):
            lock = [(0.02, s * 0.066, 0.06), (-0.005, s * 0.085, -0.04), (-0.02, s * 0.088, -0.17)]
            back += chain(lock, [0.026, 0.025, 0.018])
    return back


def head(appearance: Appearance, noise: Noise) -> Mesh:
    """The head about its middle, at the origin."""

    def paint(points: Floats, layer: NDArray[np.int64]) -> Floats:
        x, y, z = points.T
        side = points * (1, 0, 1) + np.abs(y)[:, None] * (0, 1, 0)
        skin = np.broadcast_to(appearance.skin, points.shape).astype(np.float32)
        skin = mix(
            skin,
            appearance.skin * (1.04, 0.80, 0.78),
            0.45 * spot(side, (0.07, 0.04, -0.035), (0.04, 0.022, 0.022), 1.5),
        )
        skin = mix(
            skin, appearance.hair * 0.9, appearance.beard * spot(points, (0.05, 0, -0.095), (0.09, 0.09, 0.058), 0.25)
        )
        lips = appearance.skin * ((0.85, 0.45, 0.45) if appearance.feminine else (0.82, 0.58, 0.55))
        skin = mix(skin, lips, spot(points, (0.09, 0, -0.066), (0.03, 0.025, 0.010), 0.3))
        skin = mix(skin, lips * 0.45, 0.8 * spot(points, (0.09, 0, -0.066), (0.03, 0.023, 0.0025), 0.8))
        skin = mix(skin, appearance.skin * 0.7, 0.7 * spot(side, (0.08, 0.032, 0.004), (0.04, 0.024, 0.016), 0.8))
        skin = mix(skin, (0.93, 0.92, 0.90), spot(side, (0.08, 0.032, 0.001), (0.04, 0.018, 0.009), 0.25))
        skin = mix(skin, (0.10, 0.07, 0.05), spot(side, (0.08, 0.031, 0.001), (0.04, 0.009, 0.0095), 0.25))
        skin = mix(skin, appearance.hair * 0.8, spot(side, (0.08, 0.035, 0.0255), (0.04, 0.022, 0.0052), 0.4))
        skin = mix(skin, appearance.skin * 0.4, spot(side, (0.105, 0.008, -0.042), (0.02, 0.005, 0.004), 0.5))
        strands = (
            appearance.hair * (1 + 0.35 * noise(points, (0.02, 0.006, 0.03)) + 0.2 * noise(points, 0.006))[:, None]
        )
        cap = appearance.accent * (1 - 0.25 * (np.abs(np.sin(np.arctan2(y, x + 0.012) * 3)) < 0.08))[:, None]
        band = mix(cap, appearance.accent * 0.6, (z < 0.035) & (appearance.cap == "beanie"))
        return np.where(layer[:, None] == 0, skin, np.where(layer[:, None] == 1, strands, band)).astype(np.float32)

    def relief(points: Floats) -> Floats:
        hairy = (
            np.clip((np.hypot(points[:, 0] + 0.03, points[:, 1]) - 0.08) / 0.02, 0, 1)
            if appearance.style == "curly"
            else 0
        )
        bumps: Floats = (0.008 * noise(points, 0.018) * hairy).astype(np.float32) * (points[:, 0] < 0.06)
        return bumps

    return body(_head_layers(appearance), 0.0085, paint, relief=relief)


def hand(appearance: Appearance, arm: Limb, side: int) -> Mesh:
    """A hand on its wrist, fingers along the forearm, thumb forward."""
    blobs = [cone((-0.025, 0, 0), (0.075, 0, 0), (0.026, 0.024), flat=(0, 0, 0.45))]
    for k, length in enumerate((0.165, 0.18, 0.172, 0.15)):
        z = 0.027 - 0.018 * k
        blobs += chain([(0.07, 0, z), (0.12, -0.004, z), (length, -0.018, z)], [0.0125, 0.0115, 0.0095])
    blobs += chain([(0.02, 0, 0.03), (0.06, -0.01, 0.055), (0.095, -0.015, 0.058)], [0.016, 0.014, 0.011])

    def paint(points: Floats, layer: NDArray[np.int64]) -> Floats:
        shade = 1 - 0.12 * (points[:, 1] < -0.005) * 1.0
        colours: Floats = (appearance.skin * shade[:, None]).astype(np.float32)
        return colours

    mesh = body([Layer(tuple(blobs), 0.012)], 0.0105, paint, texels=2)
    along = arm.end / np.linalg.norm(arm.end)
    hint = np.array([1.0, 0, 0.2]) if abs(along[2]) > 0.7 else np.array([0, 0, 1.0])
    thumb = hint - along * (hint @ along)
    thumb /= np.linalg.norm(thumb)
    frame = np.eye(4)
    frame[:3, :3] = 0.92 * np.stack([along, side * np.cross(thumb, along), thumb], 1)
    frame[:3, 3] = arm.joints[2]
    return transform(mesh, frame)
