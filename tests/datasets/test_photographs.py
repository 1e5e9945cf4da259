"""Sets as phones, other programs and other computers leave them: EXIF orientation,
masks, folders, names.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

from attacks import cli
from mi_splat.cameras.camera import Camera, View, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.datasets import Dataset, DatasetError, DatasetWarning, load_dataset
from mi_splat.datasets.frames import read_picture, turned_clockwise
from mi_splat.render.renderer import Renderer
from mi_splat.training.config import FitConfig
from mi_splat.training.evaluation import score
from mi_splat.training.loop import TrainState, fit
from mi_splat.training.resume import save_state
from mi_splat.training.strategies import strategy_config
from tests.datasets.sets import (
    CLOUD,
    PROBES,
    TESTS,
    VIEWS,
    lens_set,
    write_colmap,
    write_transforms,
)
from tests.gaussians import varied_scene

CAMERA = VIEWS[0].camera
ORIENTATIONS = {1: 0, 6: 1, 3: 2, 8: 3}
"""Of EXIF, and by how many quarter turns clockwise each makes an image upright."""


def with_orientation(file: Path, orientation: int, *, name: str | None = None) -> None:
    """Write an image again with an EXIF orientation."""
    image = Image.open(file)
    image.load()
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    image.save(file if name is None else file.with_name(name), exif=exif)


def turned(image: torch.Tensor, quarter_turns: int) -> torch.Tensor:
    return torch.rot90(image, -quarter_turns)


# EXIF orientation


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_a_turned_camera_renders_the_turned_image(quarter_turns: int) -> None:
    render = Renderer()
    pose = CAMERA.to_world.clone()
    pose[:3, 3] = 0.9 * pose[:3, 3]
    camera = Camera(
        to_world=pose,
        lens=Lens(focal=(41.0, 43.0), size=(40, 24), principal=(17.25, 13.5)),
    )
    scene = varied_scene(30, degree=1, seed=3)
    image = render(scene, camera)
    assert float(image.std()) > 0.01
    again = render(scene, turned_clockwise(camera, quarter_turns))
    torch.testing.assert_close(again, turned(image, quarter_turns), atol=2e-5, rtol=0)


@pytest.mark.parametrize(("orientation", "quarter_turns"), ORIENTATIONS.items())
@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_photographs_are_turned_with_their_cameras(
    write: Callable[..., None], orientation: int, quarter_turns: int, tmp_path: Path
) -> None:
    write(tmp_path, VIEWS[:2])
    plain = load_dataset(tmp_path, split=None)
    with_orientation(tmp_path / "images" / "train_00000.png", orientation)
    views = load_dataset(tmp_path, split=None)
    assert torch.equal(views[0].image, turned(plain[0].image, quarter_turns))
    assert torch.equal(views[1].image, plain[1].image)
    camera = plain.cameras[0]
    pixels, depths = project_points(PROBES, views.cameras[0])
    before, as_before = project_points(PROBES, camera)
    for _ in range(quarter_turns):
        before = torch.stack([camera.height - before[:, 1], before[:, 0]], 1)
        camera = turned_clockwise(camera, 1)
    torch.testing.assert_close(pixels, before)
    torch.testing.assert_close(depths, as_before)


def test_cameras_of_upright_images_are_not_turned_again(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS[:2])
    plain = load_dataset(tmp_path, split=None)
    image = plain[0].image
    file = tmp_path / "images" / "train_00000.png"
    # as a phone stores it
    Image.fromarray(np.rot90(np.asarray(Image.open(file)), 1)).save(file)
    with_orientation(file, 6)
    views = load_dataset(tmp_path, split=None)
    assert torch.equal(views[0].image, image)
    assert torch.equal(views.cameras[0].to_world, plain.cameras[0].to_world)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photograph_alone_is_shown_as_by_other_programs(
    orientation: int, tmp_path: Path
) -> None:
    from PIL import ImageOps

    file = tmp_path / "photo.jpg"
    pixels = np.random.default_rng(0).integers(0, 256, (12, 20, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(file)
    with_orientation(file, orientation)
    image, _ = read_picture(file, downscale=1, background=(0.0, 0.0, 0.0), upright=True)
    wanted = np.asarray(ImageOps.exif_transpose(Image.open(file)))
    assert (255 * image).round().numpy().astype(np.uint8).tolist() == wanted.tolist()


def test_distortion_is_undone_before_a_photograph_is_turned(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    lens_set(
        tmp_path,
        "OPENCV",
        [70.0, 71.0, 39.0, 31.0, -0.1, 0.02, 0.003, 0.001],
        pixels,
        count=2,
    )
    plain = load_dataset(tmp_path, split=None)
    with_orientation(tmp_path / "images" / "0.png", 6)
    views = load_dataset(tmp_path, split=None)
    torch.testing.assert_close(
        views[0].image, turned(plain[0].image, 1), atol=0, rtol=0
    )
    assert (views.cameras[0].width, views.cameras[0].height) == (
        plain.cameras[0].height,
        plain.cameras[0].width,
    )


# Masks


def left_half(view: View) -> torch.Tensor:
    mask = torch.zeros(view.camera.height, view.camera.width)
    mask[:, : view.camera.width // 2] = 1.0
    return mask


@pytest.mark.parametrize(
    "name",
    ["train_00000.png", "train_00000.png.png", "train_00000.PNG", "train_00000.jpg"],
)
@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_masks_lie_beside_their_images(
    write: Callable[..., None], name: str, tmp_path: Path
) -> None:
    write(tmp_path, VIEWS[:2])
    (tmp_path / "masks").mkdir()
    pixels = (255 * left_half(VIEWS[0])).numpy().astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "masks" / name, quality=100)
    views = load_dataset(tmp_path, split=None)
    mask = views.loss_mask(0)
    assert mask is not None
    torch.testing.assert_close(mask, left_half(VIEWS[0]), atol=0.03, rtol=0)
    assert views.loss_mask(1) is None
    assert views.alpha(0) is None


def name_masks(folder: Path, names: Sequence[str]) -> None:
    """Let the first frames of a transforms file name their masks."""
    file = folder / "transforms_train.json"
    document = json.loads(file.read_text())
    for frame, name in zip(document["frames"], names, strict=False):
        frame["mask_path"] = name
    file.write_text(json.dumps(document))


def test_masks_that_frames_name(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS[:2], masks=[left_half(VIEWS[0])])
    (tmp_path / "masks").rename(tmp_path / "people")
    assert load_dataset(tmp_path).loss_mask(0) is None
    name_masks(tmp_path, ["people\\train_00000.png"])
    mask = load_dataset(tmp_path).loss_mask(0)
    assert mask is not None
    assert torch.equal(mask, left_half(VIEWS[0]))
    # A mask that is missing is not looked for among the images, which have the same
    # name.
    name_masks(tmp_path, ["people/train_00000.png", "none/train_00001.png"])
    with pytest.warns(DatasetWarning, match=r"1 of 2 masks missing"):
        assert load_dataset(tmp_path).loss_mask(1) is None


def test_a_mask_of_the_upright_photograph(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS[:1])
    with_orientation(tmp_path / "images" / "train_00000.png", 6)
    (tmp_path / "masks").mkdir()
    upright = torch.zeros(18, 13)
    upright[:5] = 1.0
    Image.fromarray((255 * upright).numpy().astype(np.uint8)).save(
        tmp_path / "masks" / "train_00000.png"
    )
    mask = load_dataset(tmp_path).loss_mask(0)
    assert mask is not None
    assert torch.equal(mask, upright)


def trained(views: Dataset) -> torch.Tensor:
    config = FitConfig(iterations=4, strategy=strategy_config("fixed"), sh_degree=0)
    return fit(
        views, varied_scene(20, degree=0, seed=1), render=Renderer(), config=config
    ).scene.sh


def test_training_does_not_see_what_is_masked(tmp_path: Path) -> None:
    """Splats are the same to the bit whatever is behind the masks, and another one
    without them.
    """
    splats = {}
    for kind in ("one", "another", "unmasked"):
        views = VIEWS[:2]
        if kind == "another":
            painted = [view.image.clone() for view in views]
            for image, view in zip(painted, views, strict=True):
                image[left_half(view) == 0] = 0.5
            views = [
                View(view.camera, image)
                for view, image in zip(views, painted, strict=True)
            ]
        masks = [] if kind == "unmasked" else [left_half(view) for view in views]
        write_transforms(tmp_path / kind, views, masks=masks)
        splats[kind] = trained(load_dataset(tmp_path / kind))
    torch.testing.assert_close(splats["one"], splats["another"], atol=1e-6, rtol=0)
    assert not torch.allclose(splats["one"], splats["unmasked"], atol=1e-3)


def test_a_training_with_masks_is_resumed_to_the_bit(tmp_path: Path) -> None:
    """Of photographs with masks, a lens that bends and an orientation; another mask is
    another training.
    """
    pixels = np.random.default_rng(0).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    folder = tmp_path / "set"
    lens_set(folder, "SIMPLE_RADIAL", [40.0, 20.0, 15.0, -0.1], pixels, count=3)
    with_orientation(folder / "images" / "1.png", 8)
    mask = np.full((30, 40), 255, np.uint8)
    mask[:10] = 0
    (folder / "masks").mkdir()
    Image.fromarray(mask).save(folder / "masks" / "2.png")
    words = [
        "train",
        str(folder),
        "--random",
        "40",
        "--strategy",
        "fixed",
        "--sh-degree",
        "0",
        "--eval-interval",
        "0",
    ]
    words += ["--checkpoint-every", "3", "--iterations", "7"]
    assert cli.main([*words, "--out", str(tmp_path / "whole")]) == 0

    def stop(state: TrainState, path: Path) -> None:
        save_state(state, path)
        if state.iteration == 3:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mi_splat.training.resume.save_state", stop)
        assert cli.main([*words, "--out", str(tmp_path / "stopped")]) == 130
    assert not (tmp_path / "stopped" / "splat.ply").exists()
    assert cli.main([*words, "--out", str(tmp_path / "stopped")]) == 0
    kept = [
        (tmp_path / name / "splat.ply").read_bytes() for name in ("whole", "stopped")
    ]
    assert kept[0] == kept[1]
    Image.fromarray(255 - mask).save(folder / "masks" / "2.png")
    assert cli.main([*words[:-1], "8", "--out", str(tmp_path / "stopped")]) == 1


def test_scores_are_of_what_is_not_masked(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS[:1], masks=[left_half(VIEWS[0])])
    views = load_dataset(tmp_path)
    right = left_half(VIEWS[0])[..., None] == 0
    truth = views[0].image
    for seen, error in ((truth + 0.1 * ~right, 20.0), (truth + 0.1 * right, 120.0)):
        scores = score(
            varied_scene(1, degree=0, seed=0),
            views,
            lambda _, camera, seen=seen: seen.clamp(0, 1),
        )
        assert scores is not None
        assert scores.psnr == pytest.approx(error, abs=1.5)


# Folders and names


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
@pytest.mark.parametrize("factor", [2, 4])
def test_smaller_images_alone(
    write: Callable[..., None], factor: int, tmp_path: Path
) -> None:
    write(tmp_path, VIEWS, points=CLOUD)
    plain = load_dataset(tmp_path, split=None)
    images = tmp_path / "images"
    for file in images.iterdir():
        Image.open(file).resize((round(18 / factor), round(13 / factor))).save(file)
    images.rename(tmp_path / f"images_{factor}")
    with pytest.warns(
        DatasetWarning,
        match=rf"no images/, so the smaller ones in images_{factor} are used",
    ):
        views = load_dataset(tmp_path, split=None)
    assert len(views) == len(plain)
    small = views.cameras[0]
    large = plain.cameras[0]
    assert views[0].image.shape == (round(13 / factor), round(18 / factor), 3)
    assert small.fx / large.fx == pytest.approx(small.width / large.width)
    assert small.cy / large.cy == pytest.approx(small.height / large.height)


def test_a_smaller_image_in_images_is_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path, VIEWS[:1])
    file = tmp_path / "images" / "train_00000.png"
    Image.open(file).resize((9, 7)).save(file)
    with pytest.raises(DatasetError, match="expected 18 x 13 pixels, got 9 x 7"):
        load_dataset(tmp_path, split=None)


@pytest.mark.parametrize(
    "place", ["colmap/sparse/0", "colmap/sparse", "sparse", "sparse/0", "."]
)
def test_places_of_a_model(place: str, tmp_path: Path) -> None:
    write_colmap(tmp_path / "set", VIEWS, points=CLOUD)
    model = tmp_path / "moved"
    (tmp_path / "set" / "sparse" / "0").rename(model)
    (tmp_path / "set" / "sparse").rmdir()
    target = tmp_path / "set" / place
    target.mkdir(parents=True, exist_ok=True)
    for file in model.iterdir():
        file.rename(target / file.name)
    assert len(load_dataset(tmp_path / "set", split=None)) == len(VIEWS)
    assert len(load_dataset(target, split=None)) == len(VIEWS)


NAMES: dict[str, Callable[[str], str]] = {
    "backslashes": lambda name: f"images\\{name}",
    "this folder": lambda name: f".\\images\\{name}",
    "Windows": lambda name: f"C:\\Users\\someone\\set\\images\\{name}",
    "another drive": lambda name: f"D:/sets/desk/images/{name}",
    "absolute": lambda name: f"/home/someone/set/images/{name}",
    "from elsewhere": lambda name: f"../../../set/images/{name}",
    "without a folder": lambda name: name,
    "without an ending": lambda name: f"images/{name[:-4]}",
    "capitals": lambda name: f"images/{name[:-4]}.PNG",
    "small letters of a JPEG": lambda name: f"images/{name[:-4]}.jpg",
}


@pytest.mark.parametrize("spell", NAMES.values(), ids=NAMES)
def test_names_of_other_computers(spell: Callable[[str], str], tmp_path: Path) -> None:
    write_transforms(tmp_path / "set", VIEWS)
    file = tmp_path / "set" / "transforms_train.json"
    document = json.loads(file.read_text())
    for number, frame in enumerate(document["frames"]):
        frame["file_path"] = spell(f"train_{number:05d}.png")
    file.write_text(json.dumps(document))
    views = load_dataset(tmp_path / "set")
    assert [path.name for path in views.paths] == [
        f"train_{number:05d}.png" for number in range(len(VIEWS))
    ]
    assert torch.equal(views[1].image, VIEWS[1].image)


def test_upper_case_files_of_a_model_in_small_letters(tmp_path: Path) -> None:
    write_colmap(tmp_path, VIEWS)
    for file in (tmp_path / "images").iterdir():
        file.rename(file.with_suffix(".PNG"))
    assert len(load_dataset(tmp_path, split=None)) == len(VIEWS)


def test_nothing_outside_of_the_set_is_read(tmp_path: Path) -> None:
    write_transforms(tmp_path / "a" / "b" / "set", VIEWS[:1])
    (tmp_path / "a" / "b" / "set" / "images" / "train_00000.png").rename(
        tmp_path / "a" / "train_00000.png"
    )
    file = tmp_path / "a" / "b" / "set" / "transforms_train.json"
    document = json.loads(file.read_text())
    for name in (
        "../../train_00000.png",
        str(tmp_path / "a" / "train_00000.png"),
        "..\\..\\train_00000.png",
    ):
        document["frames"][0]["file_path"] = name
        file.write_text(json.dumps(document))
        with pytest.raises(
            DatasetError, match=r"the name of a file in the set|1 of 1 images missing"
        ):
            load_dataset(tmp_path / "a" / "b" / "set")


# Fields of view


@pytest.mark.parametrize("focal", [166_503.9, 0.1])
def test_a_focal_length_that_is_hardly_meant_is_warned_of(
    focal: float, tmp_path: Path
) -> None:
    views = [
        View(
            Camera(to_world=CAMERA.to_world, lens=Lens(focal=focal, size=(18, 13))),
            VIEWS[0].image,
        )
    ]
    write_colmap(tmp_path, views, test=TESTS[:1])
    with pytest.warns(
        DatasetWarning,
        match=r"1 of 1 cameras have a field of view of .* check the unit",
    ):
        load_dataset(tmp_path)
