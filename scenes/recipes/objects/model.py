"""Objects as detectors are taught them, and parts that are joined."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mi_splat.capture.mesh import Asset, Mesh


@dataclass(frozen=True, slots=True, eq=False)
class Model(Asset):
    """An object and what holds it up.

    COCO's boxes leave out what only holds an object up: a stop sign is its plate, not
    its post.
    """

    supports: int = 0  # how many of the last meshes only hold the object up

    @property
    def body(self) -> Model:
        """The object without what holds it up: what a box is drawn around."""
        count = len(self.meshes) - self.supports
        return replace(self, meshes=self.meshes[:count], supports=0)

    @property
    def support(self) -> tuple[Mesh, ...]:
        """What holds it up."""
        return self.meshes[len(self.meshes) - self.supports :]


def join(*meshes: Mesh) -> Mesh:
    """One mesh from parts that share texture, roughness and shading (those of the first
    are taken).
    """
    sizes = [len(mesh.vertices) for mesh in meshes]
    starts = np.cumsum([0, *sizes[:-1]])
    faces = [
        mesh.faces + np.uint32(start)
        for mesh, start in zip(meshes, starts, strict=True)
    ]
    return replace(
        meshes[0],
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate(faces),
        uvs=np.concatenate([mesh.uvs for mesh in meshes]),
    )
