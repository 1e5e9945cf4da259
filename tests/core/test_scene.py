"""GaussianScene: what it refuses, and that its methods do what they say."""

import re
from typing import Any

import hypothesis
import pytest
import torch
from hypothesis import strategies as st
from torch import Tensor

from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.maths.rotation import normalise, to_matrix
from mi_splat.maths.sh import sh_to_colour
from mi_splat.scene import GaussianScene, Similarity, merge, scene_hash
from tests.gaussians import random_scene


def parts(scene: GaussianScene) -> dict[str, Any]:
    return dict(zip(ATTRIBUTES, scene.tensors(), strict=True))


def changed(value: Tensor, index: tuple[int, ...], to: float) -> Tensor:
    value = value.clone()
    value[index] = to
    return value


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("means", [[0.0] * 3] * 3, "means: expected a torch tensor, got list"),
        ("means", torch.zeros(3, 2), "means: expected shape (3, 3), got (3, 2)"),
        ("means", torch.zeros(()), "means: expected shape (0, 3), got ()"),
        ("means", torch.zeros(2, 3), "scales: expected shape (2, 3), got (3, 3)"),
        ("scales", torch.ones(3), "scales: expected shape (3, 3), got (3,)"),
        ("rotations", torch.ones(3, 3), "rotations: expected shape (3, 4), got (3, 3)"),
        ("opacities", torch.ones(3, 1), "opacities: expected shape (3,), got (3, 1)"),
        ("sh", torch.ones(3, 5, 3), "sh: expected 1, 4, 9 or 16 coefficients, got 5"),
        (
            "means",
            torch.zeros(3, 3, dtype=torch.float16),
            "means: expected float32 or float64, got torch.float16",
        ),
        (
            "sh",
            torch.ones(3, 4, 3, dtype=torch.float64),
            "sh: expected torch.float32 like the means",
        ),
        (
            "sh",
            torch.ones(3, 4, 3, device="meta"),
            "sh: expected device cpu like the means, got meta",
        ),
    ],
)
def test_wrong_form_is_refused(name: str, value: object, words: str) -> None:
    with pytest.raises(InvalidValueError, match=re.escape(words)) as caught:
        GaussianScene(**{**parts(random_scene(3, 1)), name: value})
    assert isinstance(caught.value, MiSplatError)


@pytest.mark.parametrize(
    ("name", "index", "to"),
    [
        *(
            (name, index, value)
            for value in (float("nan"), float("inf"), float("-inf"))
            for name, index in (
                ("means", (4, 1)),
                ("scales", (4, 0)),
                ("rotations", (4, 3)),
                ("opacities", (4,)),
                ("sh", (4, 2, 1)),
            )
        ),
        ("means", (4, 0), -1e30),
        ("scales", (4, 1), 1e30),
        ("sh", (4, 3, 1), 1e30),
        ("scales", (4, 2), 0.0),
        ("scales", (4, 2), -1.0),
        ("rotations", (4, 0), 1.5),
        ("opacities", (4,), -1e-6),
        ("opacities", (4,), 1.0001),
    ],
)
def test_wrong_values_are_refused_and_named(
    name: str, index: tuple[int, ...], to: float
) -> None:
    scene = random_scene(6, 1)
    with pytest.raises(
        InvalidValueError,
        match=(
            rf"^{name}: expected .*got (norm )?\S+ in row 4 \(1 of 6 rows are wrong\); "
        ),
    ):
        scene.replace(**{name: changed(parts(scene)[name], index, to)})


def test_tensors_keep_their_graph() -> None:
    scene = random_scene(4, 1, dtype=torch.float64)
    leaves = [value.clone().requires_grad_() for value in scene.tensors()]
    built = GaussianScene(*(2 * leaf / 2 for leaf in leaves))
    for derived in (
        built,
        built.select(slice(None)),
        merge(built, built),
        built.with_degree(3),
        built.to("cpu"),
    ):
        total = sum(
            (value.sum() for value in derived.tensors()),
            torch.zeros((), dtype=torch.float64),
        )
        assert all(
            g is not None
            for g in torch.autograd.grad(
                total, leaves, retain_graph=True, allow_unused=True
            )
        )
    assert not any(value.requires_grad for value in built.detach().tensors())


def test_replace_checks_and_refuses_unknown_names() -> None:
    scene = random_scene(3)
    opacities = torch.full((3,), 0.25)
    other = scene.replace(opacities=opacities)
    assert other.opacities is opacities
    assert other.means is scene.means
    with pytest.raises(TypeError):
        scene.replace(colours=opacities)


@hypothesis.given(mask=st.lists(st.booleans(), min_size=0, max_size=9))
def test_select_by_mask_and_its_complement_part_the_scene(mask: list[bool]) -> None:
    scene = random_scene(len(mask))
    chosen = torch.tensor(mask, dtype=torch.bool)
    inside = scene.select(chosen)
    outside = scene.select(~chosen)
    assert len(inside) + len(outside) == len(scene)
    assert torch.equal(inside.means, scene.means[chosen])
    assert torch.equal(outside.sh, scene.sh[~chosen])


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (torch.ones(4, dtype=torch.bool), "a mask of 5 rows"),
        (torch.ones(5), "bool mask or"),
        (torch.ones(5, dtype=torch.uint8), "bool mask or"),
        (torch.ones(5, 1, dtype=torch.bool), "bool mask or"),
        (torch.tensor([0, 5]), "indices below 5"),
        (torch.tensor([-6]), "indices below 5"),
    ],
)
def test_select_refuses_what_is_no_selection(rows: Tensor, words: str) -> None:
    with pytest.raises(InvalidValueError, match=words):
        random_scene(5).select(rows)


def test_merge_keeps_order_and_pads_lower_degrees() -> None:
    first = random_scene(2, 0)
    second = random_scene(3, 2, seed=1)
    both = merge(first, second)
    assert (len(both), both.degree) == (5, 2)
    assert torch.equal(both.means, torch.cat([first.means, second.means]))
    assert torch.equal(both.sh[:2, :1], first.sh)
    assert not both.sh[:2, 1:].any()
    assert torch.equal(both.sh[2:], second.sh)
    assert scene_hash(both.select(slice(2, 5))) == scene_hash(second)
    assert scene_hash(merge(first)) == scene_hash(first)


def test_with_degree_pads_and_cuts() -> None:
    scene = random_scene(3, 2)
    assert torch.equal(scene.with_degree(3).with_degree(2).sh, scene.sh)
    assert torch.equal(scene.with_degree(1).sh, scene.sh[:, :4])
    with pytest.raises(InvalidValueError, match="degree"):
        scene.with_degree(4)


def test_to_changes_dtype_and_back() -> None:
    scene = random_scene(4)
    wide = scene.to(dtype=torch.float64)
    assert wide.means.dtype == torch.float64
    assert scene_hash(wide.to("cpu", torch.float32)) == scene_hash(scene)
    with pytest.raises(InvalidValueError, match="float32 or float64"):
        scene.to(dtype=torch.float16)
    with pytest.raises(InvalidValueError, match="finite"):
        wide.replace(means=wide.means + 1e300).to(dtype=torch.float32)


def test_hash_depends_on_every_tensor_and_on_nothing_else() -> None:
    scene = random_scene(4, 1)
    assert len(scene_hash(scene)) == 64
    copies = GaussianScene(
        *(value.clone().requires_grad_() for value in scene.tensors())
    )
    strided = GaussianScene(
        *(value.repeat_interleave(2, 0)[::2] for value in scene.tensors())
    )
    assert scene_hash(copies) == scene_hash(scene) == scene_hash(strided)
    others = [
        scene.replace(means=scene.means + 1),
        scene.replace(scales=scene.scales * 2),
        scene.replace(rotations=-scene.rotations),
        scene.replace(opacities=1 - scene.opacities),
        scene.replace(sh=-scene.sh),
        scene.select(slice(3)),
        scene.select(slice(0)),
        scene.with_degree(2),
        scene.to(dtype=torch.float64),
    ]
    assert len({scene_hash(other) for other in (scene, *others)}) == len(others) + 1


# Scenes moved, turned and resized: covariances and colours go with them


def turn(seed: int) -> Tensor:
    quaternion = torch.randn(
        4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    return to_matrix(normalise(quaternion))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_transform_moves_covariances_and_colours_with_the_scene(
    degree: int, seed: int
) -> None:
    scene = random_scene(20, degree, seed=seed, dtype=torch.float64)
    similarity = Similarity(
        turn(seed), torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64), 1.7
    )
    moved = scene.transform(similarity)
    linear = similarity.scale * similarity.rotation
    torch.testing.assert_close(
        moved.means, scene.means @ linear.T + similarity.translation
    )

    def covariance(of: GaussianScene) -> Tensor:
        axes = to_matrix(of.rotations) * of.scales[:, None, :]
        return axes @ axes.mT

    torch.testing.assert_close(covariance(moved), linear @ covariance(scene) @ linear.T)
    camera = torch.tensor([5.0, 4.0, -3.0], dtype=torch.float64)
    before = torch.nn.functional.normalize(scene.means - camera, dim=1)
    after = torch.nn.functional.normalize(
        moved.means - (linear @ camera + similarity.translation), dim=1
    )
    torch.testing.assert_close(
        sh_to_colour(moved.sh, after), sh_to_colour(scene.sh, before)
    )
    assert torch.equal(moved.opacities, scene.opacities)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rotation": 2 * torch.eye(3)}, "rotation"),
        ({"rotation": torch.diag(torch.tensor([1.0, 1.0, -1.0]))}, "rotation"),
        ({"translation": torch.tensor([0.0, 0.0, float("inf")])}, "translation"),
        ({"scale": 0.0}, "scale"),
    ],
)
def test_similarity_refuses_what_is_none(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidValueError, match=f"^{words}: expected"):
        Similarity(
            **{"rotation": torch.eye(3), "translation": torch.zeros(3), **change}
        )
