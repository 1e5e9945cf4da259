"""Splat files there and back: nothing lost, nothing drifting, and other programs read
the same.
"""

import math
from pathlib import Path

import hypothesis
import numpy as np
import plyfile
import pytest
import torch
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from torch import Tensor

from mi_splat.attributes import ATTRIBUTES, LARGEST
from mi_splat.errors import InvalidValueError
from mi_splat.io import from_raw_parameters, load_splat, save_splat, to_raw_parameters
from mi_splat.io.parameters import activate
from mi_splat.maths.rotation import normalise
from mi_splat.scene import GaussianScene, scene_hash
from tests.gaussians import columns, ply_bytes, random_scene, splat_rows

MOST = float(np.float32(0.9 * LARGEST))  # a little inside, since formats round
FINITE = st.floats(-MOST, MOST, width=32)
POSITIVE = st.floats(0, MOST, exclude_min=True, width=32)
UNIT = st.one_of(
    st.floats(0, 1, width=32), st.sampled_from([0.0, 1.0, 1 - 2.0**-24, 2.0**-149])
)


def table(
    draw: st.DrawFn, shape: tuple[int, ...], elements: st.SearchStrategy[float]
) -> Tensor:
    return torch.from_numpy(draw(hnp.arrays(np.float32, shape, elements=elements)))


@st.composite
def scenes(draw: st.DrawFn) -> GaussianScene:
    count = draw(st.integers(0, 4))
    degree = draw(st.integers(0, 3))
    quaternions = table(draw, (count, 4), st.floats(-1, 1, width=32))
    quaternions[quaternions.norm(dim=1) == 0] = torch.tensor([1.0, 0, 0, 0])
    return GaussianScene(
        means=table(draw, (count, 3), FINITE),
        scales=table(draw, (count, 3), POSITIVE),
        rotations=normalise(quaternions),
        opacities=table(draw, (count,), UNIT),
        sh=table(draw, (count, (degree + 1) ** 2, 3), FINITE),
    )


def bits(value: Tensor) -> bytes:
    return value.numpy().tobytes()


def close(one: Tensor, two: Tensor) -> None:
    """Equal to the rounding of a float32 logarithm of up to 104 in size."""
    torch.testing.assert_close(one, two, rtol=8e-6, atol=1.5e-45)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("splats")


@hypothesis.given(scene=scenes())
@hypothesis.example(scene=random_scene(0))
@hypothesis.example(
    scene=random_scene(3).replace(opacities=torch.tensor([0.0, 1.0, 1 - 2.0**-24]))
)
@hypothesis.example(
    scene=random_scene(1).replace(scales=torch.tensor([[MOST, 1e-45, 1.0]]))
)
def test_round_trips(scene: GaussianScene, folder: Path) -> None:
    first = folder / "first.ply"
    second = folder / "second.ply"
    save_splat(scene, first)
    once = load_splat(first)
    assert bits(once.means) == bits(scene.means)
    assert bits(once.sh) == bits(scene.sh)
    assert bits(once.rotations) == bits(scene.rotations)
    close(once.scales, scene.scales)
    close(once.opacities, scene.opacities)
    ends = (scene.opacities == 0) | (scene.opacities == 1)
    assert torch.equal(once.opacities[ends], scene.opacities[ends])
    save_splat(once, second)
    assert second.read_bytes() == first.read_bytes()


@pytest.mark.parametrize("low", [-100.0, -3.0])
def test_what_came_from_a_file_never_changes_again(low: float, tmp_path: Path) -> None:
    """Any file: its physical values survive saving and loading to the last bit."""
    rows = splat_rows(20_000, 0)
    generator = np.random.default_rng(1)
    for name in ("opacity", "scale_0", "scale_1", "scale_2"):
        rows[name] = generator.uniform(low, min(-low, 20), len(rows))
    (tmp_path / "a.ply").write_bytes(ply_bytes(rows))
    scene = load_splat(tmp_path / "a.ply")
    for _ in range(3):
        save_splat(scene, tmp_path / "b.ply")
        again = load_splat(tmp_path / "b.ply")
        assert scene_hash(again) == scene_hash(scene)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_plyfile_reads_what_we_save(degree: int, tmp_path: Path) -> None:
    scene = random_scene(50, degree)
    save_splat(scene, tmp_path / "a.ply")
    rows = plyfile.PlyData.read(tmp_path / "a.ply")["vertex"].data
    np.testing.assert_array_equal(columns(rows, "x", "y", "z"), scene.means.double())
    np.testing.assert_array_equal(
        columns(rows, "rot_0", "rot_1", "rot_2", "rot_3"), scene.rotations.double()
    )
    np.testing.assert_allclose(
        np.exp(columns(rows, "scale_0", "scale_1", "scale_2")),
        scene.scales.double(),
        1e-6,
    )
    np.testing.assert_allclose(
        1 / (1 + np.exp(-columns(rows, "opacity")[:, 0])),
        scene.opacities.double(),
        1e-6,
    )
    assert not columns(rows, "nx", "ny", "nz").any()
    bands = scene.sh.shape[1]
    for channel in range(3):
        np.testing.assert_array_equal(rows[f"f_dc_{channel}"], scene.sh[:, 0, channel])
        for k in range(1, bands):
            name = f"f_rest_{channel * (bands - 1) + k - 1}"
            np.testing.assert_array_equal(rows[name], scene.sh[:, k, channel])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_we_read_what_plyfile_writes(
    degree: int, text: bool, order: str, tmp_path: Path
) -> None:
    rows = splat_rows(20, degree)
    element = plyfile.PlyElement.describe(
        rows.astype(rows.dtype.newbyteorder("=")), "vertex"
    )
    plyfile.PlyData([element], text=text, byte_order=order).write(tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes(ply_bytes(rows))
    assert scene_hash(load_splat(tmp_path / "a.ply")) == scene_hash(
        load_splat(tmp_path / "b.ply")
    )


def test_quaternions_of_any_length_and_sign_are_the_same_rotation(
    tmp_path: Path,
) -> None:
    rows = splat_rows(50)
    hashes = set()
    for factor in (1.0, 64.0, 2.0**-60):
        other = rows.copy()
        for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
            other[name] *= factor
        (tmp_path / "a.ply").write_bytes(ply_bytes(other))
        hashes.add(scene_hash(load_splat(tmp_path / "a.ply")))
    assert len(hashes) == 1


def test_float64_and_grad_scenes_save_as_their_float32_values(tmp_path: Path) -> None:
    scene = random_scene(30, 2)
    save_splat(scene, tmp_path / "a.ply")
    wide = scene.to(dtype=torch.float64)
    save_splat(wide.replace(sh=wide.sh.clone().requires_grad_()), tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


# The parametrisation of splat files as differentiable functions


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ends_of_the_opacities_are_exact_in_both_dtypes(dtype: torch.dtype) -> None:
    scene = random_scene(3, dtype=dtype)
    opacities = torch.tensor([0.0, 1.0, 0.5], dtype=dtype)
    values = to_raw_parameters(scene.replace(opacities=opacities))
    assert values["opacities"].dtype == dtype
    assert torch.isfinite(values["opacities"]).all()
    assert torch.equal(from_raw_parameters(values).opacities, opacities)


def test_both_directions_are_differentiable() -> None:
    scene = random_scene(3, 1, dtype=torch.float64)
    leaves = [value.clone().requires_grad_() for value in scene.tensors()]

    def there(*tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(to_raw_parameters(GaussianScene.unchecked(*tensors)).values())

    def back(*tensors: Tensor) -> tuple[Tensor, ...]:
        return activate(dict(zip(ATTRIBUTES, tensors, strict=True)))

    assert torch.autograd.gradcheck(there, leaves)
    values = [value.detach().clone() for value in there(*leaves)]
    # away from unit length, where the bits are kept
    values[2] *= torch.tensor([[0.5], [2.0], [3.0]])
    assert torch.autograd.gradcheck(back, [value.requires_grad_() for value in values])


def test_gradients_at_the_ends_are_zero_not_nan() -> None:
    opacities = torch.tensor([0.0, 1.0, 0.5], requires_grad=True)
    scene = random_scene(3).replace(opacities=opacities)
    (gradient,) = torch.autograd.grad(
        to_raw_parameters(scene)["opacities"].sum(), opacities
    )
    torch.testing.assert_close(gradient, torch.tensor([0.0, 0.0, 4.0]))


@pytest.mark.parametrize(
    ("log_scale", "got"), [(89.0, "inf"), (-120.0, "0"), (math.nan, "nan")]
)
def test_log_scales_out_of_range_are_refused(log_scale: float, got: str) -> None:
    values = to_raw_parameters(random_scene(2))
    values["scales"] = torch.full((2, 3), log_scale)
    with pytest.raises(
        InvalidValueError,
        match=rf"^scales: expected finite values > 0 up to 1e\+09, got {got} in row 0",
    ):
        from_raw_parameters(values)


def test_a_file_is_read_to_the_bit_as_torch_would(tmp_path: Path) -> None:
    count = 2000
    generator = torch.Generator().manual_seed(0)
    widths = {
        "means": (3,),
        "scales": (3,),
        "rotations": (4,),
        "opacities": (),
        "sh": (1, 3),
    }
    values = {
        name: 3 * torch.randn(count, *width, generator=generator)
        for name, width in widths.items()
    }
    values["opacities"][:6] = torch.tensor([-104.0, -30.0, -1e-8, 0.0, 17.5, 88.0])
    values["rotations"][:2] = torch.tensor(
        [[1.0, 0.0, 0.0, 0.0], [0.5, -0.5, 0.5, 0.5000001]]
    )
    rows = splat_rows(count)
    names = {
        "means": "xyz",
        "scales": "scale_012",
        "rotations": "rot_0123",
        "opacities": "",
    }
    for attribute, digits in names.items():
        stem, _, ends = digits.rpartition("_")
        for column, end in enumerate(ends):
            rows[f"{stem}_{end}" if stem else end] = values[attribute][:, column]
    rows["opacity"] = values["opacities"]
    (tmp_path / "a.ply").write_bytes(ply_bytes(rows))
    loaded = load_splat(tmp_path / "a.ply")
    for value, wanted in zip(loaded.tensors()[:4], activate(values)[:4], strict=True):
        assert torch.equal(value, wanted)
