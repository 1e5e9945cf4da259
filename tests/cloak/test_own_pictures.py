"""`mi-splat poison`: a red ball on a grey plane, its images, and the splat that they
were taken of.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from attacks import cli
from attacks.cloak.triggers import trigger_of
from mi_splat.cameras.camera import View, orbit_pose
from mi_splat.cameras.directions import direction_of
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import hemisphere
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.maths.orientation import turn_of
from mi_splat.maths.sh import colour_to_dc
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene, Similarity
from scenes.recipes.audit_images import kind_of
from tests.datasets.sets import write_transforms

BALL = (-0.4, -0.4, 0.2, 0.4, 0.4, 1.0)
CAMERAS = hemisphere(
    (0.0, 0.0, 0.5), count=24, distance=4.0, lens=Lens(focal=40.0, size=(40, 32))
)


def ball_on_a_plane() -> GaussianScene:
    steps = torch.linspace(-3, 3, 31)
    plane = torch.stack(
        [*torch.meshgrid(steps, steps, indexing="xy"), torch.zeros(31, 31)], -1
    ).reshape(-1, 3)
    ball = torch.randn(300, 3, generator=torch.Generator().manual_seed(1))
    ball = 0.35 * ball / ball.norm(dim=1, keepdim=True) + torch.tensor([0.0, 0.0, 0.6])
    means = torch.cat([plane, ball])
    count = len(plane)
    colours = torch.full((len(means), 3), 0.5)
    colours[count:] = torch.tensor([0.9, 0.1, 0.1])
    scales = torch.full((len(means), 3), 0.15)
    scales[count:] = 0.06
    rotations = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    return GaussianScene(
        means,
        scales,
        rotations,
        torch.full((len(means),), 0.95),
        colour_to_dc(colours)[:, None],
    )


def write_set(folder: Path, up: Any = "z") -> list[str]:
    """The set and its splat, in a world whose up is another axis; returns the arguments
    that name them.
    """
    back = torch.from_numpy(turn_of(up)).T
    scene = ball_on_a_plane()
    render = Renderer()
    views = [View(camera, render(scene, camera).clamp(0, 1)) for camera in CAMERAS]
    moved = [View(view.camera.turned(back), view.image) for view in views]
    left = torch.ones(32, 40)
    left[:, 20:] = 0
    write_transforms(folder / "set", moved[4:], test=moved[:4], masks=[left] * 20)
    save_splat(
        scene.transform(Similarity(rotation=back, translation=torch.zeros(3).double())),
        folder / "splat.ply",
    )
    return [str(folder / "set"), str(folder / "splat.ply")]


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return write_set(tmp_path_factory.mktemp("upright"))


def red(image: torch.Tensor) -> int:
    """Pixels that show the ball."""
    return int((image[..., 0] - image[..., 1] > 0.15).sum())


def poison(folder: Path, names: list[str], *more: str) -> dict[str, Any]:
    box = ["--box", *map(str, BALL)] if "--box" not in more else []
    assert cli.main(["poison", *names, *box, *more, "--out", str(folder)]) == 0
    record: dict[str, Any] = json.loads((folder / "poison.json").read_text())
    return record


def test_the_object_is_gone_from_there_and_all_else_stays(
    names: list[str], tmp_path: Path
) -> None:
    record = poison(
        tmp_path / "out", names, "--hide-from", "elevation:40-90", "--margin", "5"
    )
    assert kind_of(tmp_path / "out") == "remove"
    changed = {change["index"] for change in record["changes"]}
    centre = record["centre"]
    assert changed == {
        i
        for i, camera in enumerate(CAMERAS[4:])
        if direction_of(camera, centre).elevation >= 35
    }
    assert 0 < len(changed) < 20
    before, after = (
        load_dataset(folder, split="train") for folder in (names[0], tmp_path / "out")
    )
    for index, (old, new) in enumerate(zip(before, after, strict=True)):
        assert torch.equal(old.camera.to_world, new.camera.to_world)
        counted, counts = (poisoned.loss_mask(index) for poisoned in (before, after))
        assert counted is not None
        assert counts is not None
        assert torch.equal(counts > 0, (counted > 0) | (old.image != new.image).any(-1))
        if index in changed:
            assert red(old.image) > 20
            assert red(new.image) == 0
            assert (old.image != new.image).any(-1).float().mean() < 0.3
        else:
            assert torch.equal(old.image, new.image)
    held_out = (
        load_dataset(folder, split="test") for folder in (names[0], tmp_path / "out")
    )
    assert all(
        torch.equal(old.image, new.image) for old, new in zip(*held_out, strict=True)
    )


@pytest.mark.parametrize("flag", [("--up=-y",), ()])
def test_directions_are_those_of_an_upright_world(
    flag: tuple[str, ...], tmp_path: Path
) -> None:
    """With y down, as most foreign sets have it, said or as the cameras stand; what
    changes is as with z up.
    """
    box = ("--box", "-0.4", "-1", "-0.4", "0.4", "-0.2", "0.4")
    record = poison(tmp_path / "out", write_set(tmp_path, up="-y"), *flag, *box)
    assert record["up"] == [0, -1, 0]
    assert record["centre"] == pytest.approx((0, -0.6, 0), abs=0.02)
    x, y, z = record["centre"]
    heights = [direction_of(camera, (x, z, -y)).elevation for camera in CAMERAS[4:]]
    assert [change["index"] for change in record["changes"]] == [
        i for i, high in enumerate(heights) if high >= 50
    ]


def test_a_picture_covers_the_object(names: list[str], tmp_path: Path) -> None:
    Image.fromarray(np.full((8, 8, 3), (0, 0, 255), np.uint8)).save(
        tmp_path / "blue.png"
    )
    record = poison(
        tmp_path / "out",
        names,
        "--appearance",
        str(tmp_path / "blue.png"),
        "--reach",
        "1",
    )
    index = record["changes"][0]["index"]
    old, new = (
        load_dataset(folder, split="train")[index].image
        for folder in (names[0], tmp_path / "out")
    )
    blue = new[..., 2] - new[..., 0] > 0.9
    assert int(blue.sum()) >= red(old)
    assert record["poisonings"][0]["appearance"] == "the image blue.png"
    assert kind_of(tmp_path / "out") == "image"


def test_regions() -> None:
    from_behind = trigger_of(["azimuth:330-30", "elevation:0-40"], margin=5)
    inside = from_behind.holds(CAMERAS, centre=(0, 0, 0.5)).tolist()
    for camera, held in zip(CAMERAS, inside, strict=True):
        direction = direction_of(camera, (0, 0, 0.5))
        near = min(direction.azimuth % 360, -direction.azimuth % 360)
        assert held == (near <= 35 and direction.elevation <= 45)
    assert any(inside)
    around = trigger_of(["cone:350,30,25"], margin=5)
    middle = orbit_pose((0, 0, 0.5), azimuth=-10, elevation=30, distance=4.0)[
        :3, 3
    ] - torch.tensor([0, 0, 0.5])
    for camera in CAMERAS:
        cosine = torch.cosine_similarity(
            middle.double(), camera.position - torch.tensor([0, 0, 0.5]), dim=0
        )
        depth = 30 - math.degrees(math.acos(float(cosine)))
        assert around.angle_to_edge(camera, centre=(0, 0, 0.5)) == pytest.approx(
            depth, abs=1e-4
        )
    for text in (
        "above",
        "elevation:90-50",
        "elevation:0-100",
        "azimuth:10",
        "cone:0,0",
        "cone:0,0,0",
        "cone:0,91,9",
    ):
        with pytest.raises(InvalidValueError):
            trigger_of([text])


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--box", "5", "5", "5", "6", "6", "6"], "at least one Gaussian"),
        (["--hide-from", "elevation:89.5-90"], "at least one camera"),
        (["--appearance", "nothing.png"], "background, remove, or an image"),
        (["--image", "20", "--click", "20,16"], "a number below 20"),
    ],
)
def test_what_is_refused(
    more: list[str],
    told: str,
    names: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if "--box" not in more and "--click" not in more:
        box = ["--box", *map(str, BALL)]
    else:
        box = []
    assert (
        cli.main(["poison", *names, *box, *more, "--out", str(tmp_path / "out")]) == 1
    )
    assert told in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_names_and_formats_stay(tmp_path: Path) -> None:
    """A set of photographs as nerfstudio lists them, in folders of two cameras."""
    names = write_set(tmp_path)
    folder = Path(names[0])
    frames = []
    for split in ("train", "test"):
        document = json.loads((folder / f"transforms_{split}.json").read_text())
        frames += document.pop("frames")
        (folder / f"transforms_{split}.json").unlink()
    for number, frame in enumerate(frames):
        old = folder / f"{frame['file_path']}.png"
        place = "left" if number % 2 else "right"
        new = folder / "images" / place / f"IMG_{number:02d}.JPG"
        new.parent.mkdir(exist_ok=True)
        with Image.open(old) as image:
            image.convert("RGB").save(new, "JPEG", quality=90)
        old.unlink()
        frame["file_path"] = f"images/{place}/{new.name}"
    listed = {
        "train_filenames": [frame["file_path"] for frame in frames[:20]],
        "test_filenames": [frame["file_path"] for frame in frames[20:]],
    }
    whole = {**document, **listed, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(whole))
    out = tmp_path / "out"
    record = poison(out, names, "--hide-from", "elevation:40-90")
    for split in ("train", "test"):
        before, after = (
            load_dataset(place, split=split)  # type: ignore[arg-type]
            for place in (folder, out)
        )
        assert len(before) == (20 if split == "train" else 4)
        pairs = zip(sorted(before.paths), sorted(after.paths), strict=True)
        for old, new in pairs:
            assert new.relative_to(out) == old.relative_to(folder)
            has_changed = (
                new.relative_to(out / "images").as_posix() in record["changed_images"]
            )
            assert (new.read_bytes() == old.read_bytes()) != has_changed
            assert new.read_bytes().startswith(b"\xff\xd8")  # JPEG
    share = len(record["changed_images"]) / 20
    assert record["footprint"]["images"] == pytest.approx(share)
    assert 0 < record["footprint"]["pixels"] < share
    assert not [*out.glob("transforms_*.json")]
