"""A mesh file to capture and train on: `python benchmarks/mesh_file.py out/knot.glb`.

A trefoil knot with a textured skin, as any modelling program could write it: no part of
it is one of the project's assets, and it is loaded as a user's own file is.
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

ALONG = 900
AROUND = 36
RADIUS = 0.45
TUBE = 0.2
"""Of the knot and of its tube, metres."""

Floats = NDArray[np.float64]


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    path = parser.parse_args().out
    turn, angle = np.meshgrid(
        np.linspace(0, 1, ALONG + 1), np.linspace(0, 1, AROUND + 1), indexing="ij"
    )
    vertices = _surface(turn.ravel() * 2 * np.pi, angle.ravel() * 2 * np.pi)
    corner = (np.arange(ALONG)[:, None] * (AROUND + 1) + np.arange(AROUND)).ravel()
    first = corner + AROUND + 1
    second = corner + 1
    faces = np.concatenate(
        [
            np.stack([corner, first, second], axis=1),
            np.stack([first, first + 1, second], axis=1),
        ],
    )
    uvs = np.stack([12 * turn.ravel(), angle.ravel()], axis=1)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(_skin(256)),
        metallicFactor=0.0,
        roughnessFactor=0.9,
    )
    visual = trimesh.visual.TextureVisuals(uv=uvs, material=material)
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(vertices, faces, visual=visual, process=False).export(path)


def _surface(t: Floats, angle: Floats) -> Floats:
    """(N, 3) points of the tube around a trefoil knot, y up."""

    def centre(s: Floats) -> Floats:
        reach = 2 + np.cos(3 * s)
        return RADIUS * np.stack(
            [reach * np.cos(2 * s), np.sin(3 * s), reach * np.sin(2 * s)], axis=1
        )

    tangent = centre(t + 1e-4) - centre(t - 1e-4)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(side, tangent)
    surface: NDArray[np.float64] = centre(t) + TUBE * (
        np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
    )
    return surface


def _skin(size: int) -> NDArray[np.uint8]:
    """(size, size, 3) stripes, dots and a gradient."""
    v, u = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size), indexing="ij")
    picture = np.stack(
        [0.25 + 0.6 * v, 0.35 + 0.3 * np.sin(2 * np.pi * u), 0.75 - 0.5 * v], axis=2
    )
    picture[(4 * u % 1) < 0.18] = (0.92, 0.9, 0.82)
    dots = ((4 * u % 1 - 0.6) ** 2 + (4 * v % 1 - 0.5) ** 2) < 0.05
    picture[dots] = (0.12, 0.12, 0.18)
    return (255 * picture.clip(0, 1)).astype(np.uint8)


if __name__ == "__main__":
    main()
