"""GaussianScene: the one value that every part of the library passes around."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.attributes import ATTRIBUTES, LARGEST, values_hash
from mi_splat.errors import InvalidValueError
from mi_splat.maths import rotation as quaternion
from mi_splat.maths.sh import coefficient_count, degree_of, rotate_sh

UNIT_TOLERANCE = 1e-3
"""How far from one the norm of a scene's quaternions may be."""


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """World transform x -> scale * rotation @ x + translation."""

    rotation: Tensor  # (3, 3) rotation matrix
    translation: Tensor  # (3,) world units
    scale: float = 1.0  # factor > 0

    def __post_init__(self) -> None:
        if not quaternion.is_rotation(self.rotation):
            do = "put any scale into `scale`"
            raise InvalidValueError.of(
                "rotation", "a (3, 3) rotation matrix", self.rotation.tolist(), do
            )
        if self.translation.shape != (3,) or not bool(
            torch.isfinite(self.translation).all()
        ):
            do = "pass a tensor of shape (3,)"
            raise InvalidValueError.of(
                "translation", "three finite numbers", self.translation.tolist(), do
            )
        if not 0 < self.scale < math.inf:
            raise InvalidValueError.of(
                "scale", "a positive finite number", self.scale, "pass a size factor"
            )

    @classmethod
    def from_matrix(cls, matrix: Tensor, what: str) -> Similarity:
        """The similarity of a (4, 4) matrix that is called `what`."""
        linear = matrix[:3, :3].double()
        determinant = float(torch.linalg.det(linear))
        scale = abs(determinant) ** (1 / 3)
        defect = (
            (linear @ linear.T - scale**2 * torch.eye(3, dtype=torch.float64))
            .abs()
            .max()
        )
        if determinant <= 0 or not bool(defect <= 1e-4 * scale**2):
            do = "remove shear and mirroring"
            raise InvalidValueError.of(
                what, "rotation, translation and uniform scale", matrix.tolist(), do
            )
        return cls(
            rotation=linear / scale, translation=matrix[:3, 3].double(), scale=scale
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class GaussianScene:
    """N Gaussians in physical values: never logits, never logarithms.

    The tensors are all float32, or all float64 for gradient checks, and share one
    device. They may require gradients: the checks look at detached values and the
    tensors are kept as they are.

    Attributes:
        means: (N, 3) float32, world units, up to `LARGEST`, as scales and SH.
        scales: (N, 3) float32, standard deviations along the Gaussian's own axes, > 0,
            world units.
        rotations: (N, 4) float32 unit quaternions (w, x, y, z), local to world.
        opacities: (N,) float32 in [0, 1].
        sh: (N, K, 3) float32, K = (degree + 1)^2 with degree 0 to 3; real spherical
            harmonics of the sRGB colour in the order and sign convention of 3D Gaussian
            Splatting (Kerbl et al. 2023); colour = 0.5 + sum.

    Raises:
        InvalidValueError: A tensor has the wrong shape, dtype or device, or values that
            are not finite or out of range.
    """

    means: Tensor
    scales: Tensor
    rotations: Tensor
    opacities: Tensor
    sh: Tensor

    def __post_init__(self) -> None:
        _check_form(self)
        _check_values(self)

    @classmethod
    def unchecked(
        cls,
        means: Tensor,
        scales: Tensor,
        rotations: Tensor,
        opacities: Tensor,
        sh: Tensor,
    ) -> GaussianScene:
        """A scene of which nothing is checked; `GaussianScene(...)` is the one to take
        unless one of these holds.

        - The tensors are valid by construction: rows of a scene that was checked, or
          values out of `activate`. In an inner loop the checks cost more than the work,
          and on a GPU they wait for the device.
        - Invalid values have to pass: a loader that names the bad rows itself, a
          gradient check that steps outside.

        Nothing is copied and gradients flow through. Rendering, saving or hashing
        tensors that break the promises of the class gives wrong results without an
        error.

        Args:
            means: (N, 3) world units.
            scales: (N, 3) standard deviations > 0, world units.
            rotations: (N, 4) unit quaternions (w, x, y, z), local to world.
            opacities: (N,) in [0, 1].
            sh: (N, K, 3) sRGB, K = (degree + 1)^2.

        Returns:
            The scene.
        """
        scene = cls.__new__(cls)
        for name, value in zip(
            ATTRIBUTES, (means, scales, rotations, opacities, sh), strict=True
        ):
            object.__setattr__(scene, name, value)
        return scene

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        kind = str(self.means.dtype).removeprefix("torch.")
        return (
            f"GaussianScene({len(self):,} Gaussians, SH degree {self.degree}, {kind},"
            f" {self.means.device})"
        )

    @property
    def degree(self) -> int:
        """SH degree, 0 to 3."""
        return degree_of(self.sh.shape[1])

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The five tensors in the order of `ATTRIBUTES`.

        Returns:
            Means, scales, rotations, opacities and SH, not copied.
        """
        return self.means, self.scales, self.rotations, self.opacities, self.sh

    def replace(self, **tensors: Tensor) -> GaussianScene:
        """A scene with some of the tensors exchanged, checked like a new one.

        Args:
            tensors: New values by name: `means`, `scales`, `rotations`, `opacities`,
                `sh`, in the shapes of the class.

        Returns:
            A new scene; this one stays.

        Raises:
            InvalidValueError: A shape, a dtype or a value is wrong.
        """
        return dataclasses.replace(self, **tensors)

    def detach(self) -> GaussianScene:
        """The same values, cut from the autograd graph.

        Returns:
            A new scene, whose memory is shared.
        """
        return self.unchecked(*(value.detach() for value in self.tensors()))

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> GaussianScene:
        """The scene on another device, or in another of the two dtypes.

        Args:
            device: Where the tensors go; None leaves them where they are.
            dtype: float32 or float64; None keeps it.

        Returns:
            A new scene; tensors that are there already are not copied.
        """
        moved = [value.to(device=device, dtype=dtype) for value in self.tensors()]
        if dtype in (None, self.means.dtype):
            return self.unchecked(*moved)
        return GaussianScene(*moved)

    def select(self, rows: Tensor | slice) -> GaussianScene:
        """The Gaussians in `rows`, in that order.

        Args:
            rows: (N,) bool mask, (M,) integer indices, or a slice.

        Returns:
            A new scene of these Gaussians.

        Raises:
            InvalidValueError: rows is neither, or points outside the scene.
        """
        if not isinstance(rows, slice):
            check_rows(rows, len(self))
            rows = rows.to(self.means.device)
        return self.unchecked(*(value[rows] for value in self.tensors()))

    def transform(self, similarity: Similarity) -> GaussianScene:
        """The scene moved, turned and resized in the world; colours turn with it.

        Args:
            similarity: Rotation, scale and move from this world to the new one.

        Returns:
            A new scene.
        """
        turn = similarity.rotation.to(self.means)
        spin = quaternion.from_matrix(similarity.rotation.double()).to(self.rotations)
        return GaussianScene(
            means=similarity.scale * (self.means @ turn.T)
            + similarity.translation.to(self.means),
            scales=similarity.scale * self.scales,
            rotations=quaternion.multiply(spin, self.rotations),
            opacities=self.opacities,
            sh=rotate_sh(self.sh, similarity.rotation),
        )

    def with_degree(self, degree: int) -> GaussianScene:
        """The scene with SH of another degree: zeros are added, or the higher bands are
        cut off.

        Args:
            degree: SH degree, 0 to 3: (degree + 1)^2 coefficients for each channel.

        Returns:
            A new scene, or this one if it has this degree.
        """
        count = coefficient_count(degree)
        if count == self.sh.shape[1]:
            return self
        kept = self.sh[:, :count]
        padding = kept.new_zeros(len(self), count - kept.shape[1], 3)
        return self.unchecked(*self.tensors()[:4], torch.cat([kept, padding], dim=1))


def check_scene(what: str, value: object) -> None:
    """Raise unless a value, which the error calls `what`, is a `GaussianScene`."""
    if not isinstance(value, GaussianScene):
        raise InvalidValueError.of(
            what, "a GaussianScene", type(value).__name__, "load_splat(path) gives one"
        )


def merge(*scenes: GaussianScene) -> GaussianScene:
    """All Gaussians of several scenes, in order; SH of lower degree are padded with
    zeros.
    """
    if not scenes:
        raise InvalidValueError.of(
            "scenes", "at least one scene", "none", "pass the scenes to merge"
        )
    degree = max(scene.degree for scene in scenes)
    columns = zip(
        *(scene.with_degree(degree).tensors() for scene in scenes), strict=True
    )
    kinds = {(scene.means.dtype, scene.means.device) for scene in scenes}
    if len(kinds) > 1:
        got = ", ".join(sorted(f"{dtype} on {device}" for dtype, device in kinds))
        raise InvalidValueError.of(
            "scenes", "one dtype and device", got, "bring them together with .to()"
        )
    return GaussianScene.unchecked(*(torch.cat(column) for column in columns))


def scene_hash(scene: GaussianScene) -> str:
    """SHA-256 (hexadecimal) over names, dtypes, shapes and values of the five tensors;
    the device does not matter.
    """
    arrays = (value.detach().cpu().contiguous().numpy() for value in scene.tensors())
    return values_hash(dict(zip(ATTRIBUTES, arrays, strict=True)))


def _check_form(scene: GaussianScene) -> None:
    """Raise unless the five values are tensors of matching shape, dtype and device."""
    for name, value in zip(ATTRIBUTES, scene.tensors(), strict=True):
        if not isinstance(value, Tensor):
            raise InvalidValueError.of(
                name, "a torch tensor", type(value).__name__, "use torch.as_tensor"
            )
    count = scene.means.shape[0] if scene.means.ndim else 0
    bands = scene.sh.shape[1] if scene.sh.ndim == 3 else 1
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, bands, 3))
    for name, value, shape in zip(ATTRIBUTES, scene.tensors(), shapes, strict=True):
        if tuple(value.shape) != shape:
            wanted = str(shape) if name != "sh" else f"({count}, K, 3)"
            do = "give every tensor one row per Gaussian"
            raise InvalidValueError.of(name, f"shape {wanted}", tuple(value.shape), do)
        if (
            value.dtype not in (torch.float32, torch.float64)
            or value.dtype != scene.means.dtype
        ):
            if name == "means":
                kind = "float32 or float64"
            else:
                kind = f"{scene.means.dtype} like the means"
            raise InvalidValueError.of(
                name, kind, value.dtype, "convert it with .to(dtype)"
            )
        if value.device != scene.means.device:
            expected = f"device {scene.means.device} like the means"
            raise InvalidValueError.of(
                name, expected, value.device, "move it with .to(device)"
            )
    degree_of(bands)


_RANGES = {
    "means": (
        -LARGEST,
        LARGEST,
        f"finite values up to {LARGEST:g}",
        "remove those Gaussians",
    ),
    "scales": (
        math.ulp(0.0),
        LARGEST,
        f"finite values > 0 up to {LARGEST:g}",
        "pass standard deviations",
    ),
    "rotations": (
        1 - UNIT_TOLERANCE,
        1 + UNIT_TOLERANCE,
        "unit quaternions",
        "use mi_splat.maths.rotation.normalise",
    ),
    "opacities": (0.0, 1.0, "values in [0, 1]", "apply a sigmoid to logits"),
    "sh": (
        -LARGEST,
        LARGEST,
        f"finite values up to {LARGEST:g}",
        "remove those Gaussians",
    ),
}
"""Lowest and highest value of each tensor (of the norm for rotations), its name, and
what to do about other values.
"""


def _check_values(scene: GaussianScene) -> None:
    """Raise unless all values are finite and in range."""
    for name, value in zip(ATTRIBUTES, scene.tensors(), strict=True):
        low, high, expected, do = _RANGES[name]
        value = value.detach()
        if name == "rotations":
            judged = torch.linalg.vector_norm(value, dim=1)
        else:
            judged = value
        if not judged.numel():
            continue
        smallest, largest = torch.aminmax(judged)  # both NaN if one value is
        if low <= smallest.item() and largest.item() <= high:
            continue
        wide = judged.double().reshape(len(value), -1)
        bad = ~((wide >= low) & (wide <= high))
        rows = bad.any(1).nonzero().flatten()
        first = int(rows[0])
        kind = "norm " if name == "rotations" else ""
        shown = f"{kind}{wide[first][bad[first]][0].item():.6g}"
        got = f"{shown} in row {first} ({len(rows)} of {len(value)} rows are wrong)"
        raise InvalidValueError.of(name, expected, got, do)


def check_rows(rows: Tensor, count: int) -> None:
    """Raise unless `rows` is a mask or indices for a scene of `count` Gaussians."""
    integral = not rows.dtype.is_floating_point and not rows.dtype.is_complex
    if rows.ndim != 1 or not integral or rows.dtype == torch.uint8:
        got = f"{rows.dtype} of shape {tuple(rows.shape)}"
        raise InvalidValueError.of(
            "rows", "a (N,) bool mask or (M,) integer indices", got, "convert it"
        )
    if rows.dtype == torch.bool and len(rows) != count:
        raise InvalidValueError.of(
            "rows", f"a mask of {count} rows", len(rows), "make it from this scene"
        )
    if (
        rows.dtype != torch.bool
        and len(rows)
        and not bool(((rows >= -count) & (rows < count)).all())
    ):
        got = f"{int(rows.min())} to {int(rows.max())}"
        raise InvalidValueError.of(
            "rows", f"indices below {count}", got, "make them from this scene"
        )
