"""Where a glTF document puts its meshes: the tree of nodes, and the matrices along it (glTF 2.0, section 3.5)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from mi_splat.io.fields import Fields
from mi_splat.io.formats.encoded import Array
from mi_splat.rotation import normalise, to_matrix


def placements(root: Fields, meshes: int) -> Iterator[tuple[int, Array]]:
    """Index of a mesh and its (4, 4) matrix to the world, for each node of the first scene that has one.

    Args:
        root: The document.
        meshes: How many meshes it has.

    Raises:
        SplatFileError: Nodes are in a circle or have two parents, or a number is out of range.
    """
    nodes, scenes = root.objects("nodes"), root.objects("scenes")
    if not nodes or not scenes:
        return
    scene = scenes[root.whole("scene", 0, len(scenes) - 1, 0)]
    waiting = [(number, np.eye(4)) for number in scene.places("nodes", len(nodes))]
    seen = {number for number, _ in waiting}
    while waiting:
        number, above = waiting.pop(0)
        node = nodes[number]
        local = _matrix(node)
        matrix = above if local is None else above @ local
        if "mesh" in node.values:
            yield node.whole("mesh", 0, meshes - 1), matrix
        children = node.places("children", len(nodes))
        if seen & set(children):
            raise node.bad("children", "nodes that have no parent yet", sorted(seen & set(children)))
        seen |= set(children)
        waiting += [(child, matrix) for child in children]


def _matrix(node: Fields) -> Array | None:
    """The matrix of a node, None if it has none."""
    if "matrix" in node.values:
        return np.array(node.numbers("matrix", 16, 16)).reshape(4, 4).T  # columns come first
    if not {"translation", "rotation", "scale"} & set(node.values):
        return None
    x, y, z, w = node.numbers("rotation", 4, 4, (0, 0, 0, 1))
    if not 0.5 < w * w + x * x + y * y + z * z < 2:
        raise node.bad("rotation", "a unit quaternion", [x, y, z, w])
    matrix = np.eye(4)
    turn = to_matrix(normalise(torch.tensor([w, x, y, z], dtype=torch.float64))).numpy()
    matrix[:3, :3] = turn * np.array(node.numbers("scale", 3, 3, (1, 1, 1)))
    matrix[:3, 3] = node.numbers("translation", 3, 3, (0, 0, 0))
    return matrix
