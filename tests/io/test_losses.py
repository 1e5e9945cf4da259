"""What a format cannot hold is warned of with numbers, and nothing else is."""

import gzip
import struct
from pathlib import Path
from typing import Literal

import pytest
import torch

from mi_splat.attributes import LARGEST
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.io import (
    SplatFileError,
    SplatFileWarning,
    SplatLossWarning,
    load_splat,
    save_splat,
)
from mi_splat.io.formats import axes
from mi_splat.io.formats.format import FORMATS
from mi_splat.io.loaded import arrays_of, as_scene
from mi_splat.io.points import load_points
from mi_splat.io.splat_files import load_stored, write_splat_file
from mi_splat.maths.rotation import to_matrix
from mi_splat.maths.sh import colour_to_dc, sh_to_colour
from mi_splat.provenance import rendered_with
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import open_scene
from mi_splat.scene import GaussianScene, Similarity, scene_hash
from tests.gaussians import ply_bytes, random_scene, splat_rows
from tests.io.format_files import WRITTEN, assert_close, gltf_with, tame_scene


def changed(
    scene: GaussianScene, attribute: str, value: float, *columns: int
) -> GaussianScene:
    """The scene with another value in one column of its fourth Gaussian."""
    tensor = getattr(scene, attribute).clone()
    tensor[(3, *columns)] = value
    return scene.replace(**{attribute: tensor})


def with_dc(scene: GaussianScene, colour: float) -> GaussianScene:
    """The scene with a Gaussian whose red is `colour`."""
    return changed(scene, "sh", float(colour_to_dc(torch.tensor(colour))), 0, 0)


SCENE = tame_scene(30, 1)
FLAT = SCENE.with_degree(0)


@pytest.mark.parametrize("suffix", WRITTEN)
def test_scenes_within_the_ranges_are_saved_without_a_warning(
    suffix: str, tmp_path: Path
) -> None:
    # warnings are errors
    save_splat(FLAT if suffix == ".splat" else SCENE, tmp_path / f"a{suffix}")
    assert len(load_splat(tmp_path / f"a{suffix}")) == 30


@pytest.mark.parametrize(
    ("suffix", "scene", "words"),
    [
        (
            ".splat",
            SCENE,
            (
                r"SH above degree 0 dropped: 30 Gaussians, by up to 0\.89\d* of a"
                r" coefficient"
            ),
        ),
        (
            ".splat",
            with_dc(FLAT, -2.5),
            r"colour clamped to 0\.\.1: 1 Gaussians, by up to 2\.5 of full colour",
        ),
        (
            ".splat",
            changed(FLAT, "opacities", 0.0015),
            r"opacity rounded to 0: 1 Gaussians, by up to 0\.0015",
        ),
        (
            ".spz",
            with_dc(SCENE, 2.5),
            r"first SH clamped to -3.33\.\.3.33: 1 Gaussians, by up to 3\.7",
        ),
        (
            ".spz",
            changed(SCENE, "sh", -1.5, 2, 1),
            r"SH clamped to -1\.\.0.99: 1 Gaussians, by up to 0\.50",
        ),
        (
            ".spz",
            changed(SCENE, "means", 2e6, 1),
            r"means clipped to 524288: 1 Gaussians, by up to 1\.47\de\+06 world units",
        ),
        (
            ".spz",
            changed(SCENE, "scales", 1e-7, 1),
            r"log-scales clamped .*: 1 Gaussians, by up to 6\.0",
        ),
        (
            ".compressed.ply",
            changed(SCENE, "sh", 5.0, 2, 1),
            r"SH clamped to -4\.\.4: 1 Gaussians, by up to 1 of",
        ),
        (
            ".compressed.ply",
            changed(SCENE, "opacities", 0.001),
            "opacity rounded to 0: 1 Gaussians",
        ),
        (
            ".sog",
            changed(SCENE, "opacities", 0.001),
            "opacity rounded to 0: 1 Gaussians",
        ),
    ],
)
def test_losses_are_warned_of_with_numbers(
    suffix: str, scene: GaussianScene, words: str, tmp_path: Path
) -> None:
    path = tmp_path / f"a{suffix}"
    with pytest.warns(
        SplatLossWarning,
        match=rf"a scene that fits the format, got .*{words}.*; save it as \.ply",
    ) as caught:
        save_splat(scene, path)
    assert caught[0].filename == __file__
    load_splat(path)


def test_what_is_only_read_or_unknown_is_not_written(tmp_path: Path) -> None:
    for name, words in (
        ("meta.json", r"bundle an unbundled SOG"),
        ("a", "got no ending"),
    ):
        with pytest.raises(SplatFileError, match=words):
            save_splat(SCENE, tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("signs", [axes.X, (-1.0, 1.0, -1.0), axes.Z])
def test_half_turns_are_rotations_without_rounding(
    signs: tuple[float, float, float],
) -> None:
    scene = tame_scene(50, 3)
    turned = axes.flipped(arrays_of(scene), signs)
    wanted = scene.transform(
        Similarity(torch.diag(torch.tensor(signs)), torch.zeros(3))
    )
    assert_close(as_scene(turned), wanted, rotations=1e-3)
    assert scene_hash(as_scene(axes.flipped(turned, signs))) == scene_hash(scene)


def test_mirrors_mirror_shapes_and_colours() -> None:
    scene = tame_scene(50, 3)
    signs = (1.0, -1.0, 1.0)
    mirrored = as_scene(axes.flipped(arrays_of(scene), signs))
    mirror = torch.diag(torch.tensor(signs))
    for one, two in ((scene, mirrored), (mirrored, scene)):
        torch.testing.assert_close(mirror @ covariances(one) @ mirror, covariances(two))
    rays = torch.nn.functional.normalize(scene.means, dim=1)
    torch.testing.assert_close(
        sh_to_colour(scene.sh, rays), sh_to_colour(mirrored.sh, rays @ mirror)
    )


def covariances(scene: GaussianScene) -> torch.Tensor:
    halves = to_matrix(scene.rotations) * scene.scales[:, None]
    return halves @ halves.mT


def test_names_do_not_overrule_the_content(tmp_path: Path) -> None:
    save_splat(SCENE, tmp_path / "a.compressed.ply")
    save_splat(SCENE, tmp_path / "plain.ply")
    expected = load_splat(tmp_path / "a.compressed.ply")
    (tmp_path / "b.ply").write_bytes((tmp_path / "a.compressed.ply").read_bytes())
    assert_close(load_splat(tmp_path / "b.ply"), expected)
    (tmp_path / "c.compressed.ply").write_bytes((tmp_path / "plain.ply").read_bytes())
    assert_close(load_splat(tmp_path / "c.compressed.ply"), SCENE)
    (tmp_path / "d").write_bytes((tmp_path / "plain.ply").read_bytes())
    assert_close(load_splat(tmp_path / "d"), SCENE)


def test_nodes_of_gltf_place_their_splats(tmp_path: Path) -> None:
    """Matrices multiply along the tree, and other meshes are left out with a
    warning.
    """
    quarter = [0, 0, 0.5**0.5, 0.5**0.5]
    nodes = [
        {"children": [1], "translation": [1, 2, 3]},
        {"mesh": 0, "rotation": quarter, "scale": [2, 2, 2]},
    ]
    contents = gltf_with(lambda document: document.update(nodes=nodes))
    (tmp_path / "a.glb").write_bytes(contents)
    (tmp_path / "plain.glb").write_bytes(gltf_with(lambda document: None))
    turn = Similarity(
        torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        torch.tensor([-1.0, -2, 3]),
        2.0,
    )
    assert_close(
        load_splat(tmp_path / "a.glb"),
        load_splat(tmp_path / "plain.glb").transform(turn),
    )
    both = [{"mesh": 0}, {"mesh": 1}]

    def add(document: dict[str, object]) -> None:
        document["meshes"].append({"primitives": [{"attributes": {"POSITION": 0}}]})  # type: ignore[attr-defined]
        document.update(nodes=both, scenes=[{"nodes": [0, 1]}])

    (tmp_path / "b.glb").write_bytes(gltf_with(add))
    with pytest.warns(
        SplatFileWarning,
        match="splats only, got 1 other primitives; they were left out",
    ) as caught:
        assert len(load_splat(tmp_path / "b.glb")) == 20
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    "suffix",
    [each.suffixes[0] for each in FORMATS.own.values() if each.keeps_antialiasing],
)
def test_formats_that_can_keep_the_render_mode(suffix: str, tmp_path: Path) -> None:
    write_splat_file(SCENE, tmp_path / f"plain{suffix}")
    write_splat_file(SCENE, tmp_path / f"a{suffix}", antialiased=True)
    with pytest.warns(
        SplatFileWarning,
        match=r"trained with antialiasing; draw it with antialiased=True",
    ) as caught:
        assert_close(
            load_splat(tmp_path / f"a{suffix}"), load_splat(tmp_path / f"plain{suffix}")
        )
    assert caught[0].filename == __file__
    settings = open_scene(tmp_path / f"a{suffix}").settings
    assert settings.antialiased
    assert rendered_with(Renderer(settings))["antialiased"]  # in the records of results
    assert not open_scene(tmp_path / f"plain{suffix}").settings.antialiased


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        (["SplatRenderMode: mip"], True),
        (["antialiased 1"], True),
        (["postshot.anti_aliasing=1"], True),
        (["  SPLATRENDERMODE:  MIP"], True),
        (["antialiased 1", "antialiased 0"], False),
        (["SplatRenderMode: default", "antialiased 1"], True),
        (["antialiased images were used"], False),
    ],
)
def test_comments_that_name_the_render_mode(
    comments: list[str], expected: bool, tmp_path: Path
) -> None:
    head, body = ply_bytes(splat_rows(3)).split(b"element", 1)
    lines = b"".join(b"comment " + comment.encode() + b"\n" for comment in comments)
    (tmp_path / "a.ply").write_bytes(head + lines + b"element" + body)
    assert load_stored(tmp_path / "a.ply").is_antialiased is expected


AXES = [
    "",
    "LDB",
    "RDB",
    "LUB",
    "RUB",
    "LDF",
    "RDF",
    "LUF",
    "RUF",
    "LFD",
    "RFD",
    "LFU",
    "RFU",
    "LBD",
    "RBD",
    "LBU",
    "RBU",
]


@pytest.mark.parametrize("number", range(1, 17))
@pytest.mark.parametrize("version", [3, 4])
def test_the_axes_that_spz_can_name(
    number: int, version: Literal[3, 4], tmp_path: Path
) -> None:
    write_splat_file(SCENE, tmp_path / "a.spz", version=version)
    whole = (tmp_path / "a.spz").read_bytes()
    name = AXES[number]
    record = struct.pack("<III", 0xADBE0003, 4, number)
    if version == 3:
        plain = bytearray(gzip.decompress(whole))
        plain[14] |= 2
        whole = gzip.compress(bytes(plain) + record)
    else:
        (offset,) = struct.unpack_from("<I", whole, 16)
        head = (
            whole[:14]
            + bytes([whole[14] | 2])
            + whole[15:16]
            + struct.pack("<I", offset + len(record))
        )
        whole = head + whole[20:offset] + record + whole[offset:]
    (tmp_path / "b.spz").write_bytes(whole)
    # the numbers in the file
    stored = load_splat(tmp_path / "a.spz").means * torch.tensor([1.0, -1, -1])
    ply = {
        letter: sign * stored[:, axis]
        for axis, letter in enumerate(name)
        for sign in (1 if letter in "RDF" else -1,)
    }
    right, down, front = (
        next(ply[letter] for letter in pair if letter in ply)
        for pair in ("RL", "DU", "FB")
    )
    torch.testing.assert_close(
        load_splat(tmp_path / "b.spz").means, torch.stack([right, down, front], dim=1)
    )


# Large values: those on a map are read, what float32 cannot bear is refused by its row,
# renderers bear the rest


def test_points_too_far_away_are_named(tmp_path: Path) -> None:
    rows = splat_rows(10)
    rows["y"][7] = 1e30
    (tmp_path / "points.ply").write_bytes(ply_bytes(rows))
    with pytest.raises(
        SplatFileError,
        match=(
            r"points\.ply.*coordinates up to 1e\+09, got .* in row 7 \(1 of 10 rows\)"
        ),
    ):
        load_points(tmp_path / "points.ply")


@pytest.mark.parametrize("method", ["tile", "ray"])
@pytest.mark.parametrize("focal", [1e9, 40.0, 1e-9])
def test_renderers_bear_the_largest_values(
    method: Literal["tile", "ray"], focal: float
) -> None:
    scene = random_scene(50, 3)
    means, sh = (
        value / value.abs().max() * LARGEST for value in (scene.means, scene.sh)
    )
    large = scene.replace(means=means, scales=torch.full_like(means, LARGEST))
    for shown, eye in (
        (large, (0.9 * LARGEST, 1, 1)),
        (scene.replace(sh=sh), (3, 1, 1)),
        (scene, (LARGEST, 1, 1)),
    ):
        camera = Camera(
            to_world=look_at(eye, (0, 0, 0)), lens=Lens(focal=focal, size=(32, 24))
        )
        assert Renderer(RenderSettings(method=method))(shown, camera).isfinite().all()
