"""A repaired splat shows from everywhere what the believed directions show, and an
honest one stays as it is.
"""

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks import cli
from mi_splat.audit import Audit, audit, repaired
from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.io import load_splat, save_splat
from mi_splat.maths.metrics import psnr
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.audit.accounts import account, look
from tests.audit.scenes import Made, cone, direction, hidden, standing

ABOVE = cone(direction(90, 0), 50)


@pytest.fixture(autouse=True, scope="module")
def _few_small_pictures() -> object:
    """Of every object 60 pictures of 72 pixels, not 150 of 128."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(vars(LIMITS), "image_size", 72)
        patch.setitem(vars(LIMITS), "cameras", 60)
        yield


@pytest.fixture(scope="module")
def honest() -> Made:
    return standing("car", count=1200)


@pytest.fixture(scope="module")
def hiding(honest: Made) -> Made:
    return hidden(honest, ABOVE)


@pytest.fixture(scope="module")
def judged(hiding: Made) -> Audit:
    return audit(hiding.scene)


def picture(scene: GaussianScene, judged: Audit, *view: float) -> Tensor:
    """The object from degrees of elevation and azimuth."""
    item = judged.strongest
    centre = torch.tensor(item.centre)
    pose = look_at((centre + 3 * item.radius * direction(*view)).tolist(), item.centre)
    with torch.no_grad():
        camera = Camera(to_world=pose, lens=Lens(focal=70.0, size=(64, 64)))
        return Renderer(RenderSettings(near=0.02))(scene, camera).clamp(0, 1)


def test_a_look_is_gone_and_the_honest_colours_are_back(
    honest: Made, hiding: Made, judged: Audit
) -> None:
    again = repaired(hiding.scene, judged)
    for view, gain in (((85.0, 0.0), 8.0), ((65.0, 120.0), 5.0)):
        wanted, before, after = (
            picture(scene, judged, *view)
            for scene in (honest.scene, hiding.scene, again)
        )
        assert psnr(after, wanted) > psnr(before, wanted) + gain
    wanted, after = (
        picture(scene, judged, 15.0, 40.0) for scene in (honest.scene, again)
    )
    assert psnr(after, wanted) > 36
    assert all(
        torch.equal(a, b)
        for a, b in zip(again.tensors()[:4], hiding.scene.tensors()[:4], strict=True)
    )


def test_the_other_side_can_be_believed(hiding: Made, judged: Audit) -> None:
    """Then the object has the look from everywhere."""
    again = repaired(hiding.scene, judged, keep="inside")
    above = picture(hiding.scene, judged, 85.0, 0.0)[24:40, 24:40].mean((0, 1))
    before, after = (
        picture(scene, judged, 20.0, 40.0)[24:40, 24:40].mean((0, 1))
        for scene in (hiding.scene, again)
    )
    assert float((after - above).norm()) < 0.5 * float((before - above).norm())


def test_an_honest_splat_is_returned_as_it_is() -> None:
    scene = standing("suitcase", count=8).scene
    assert repaired(scene, account(look(0.001), count=len(scene))) is scene


def test_what_covers_an_object_is_left_out_where_others_look_through_it() -> None:
    positions = torch.zeros(6, 3)
    positions[:, 2] = torch.tensor([-0.1, 0.1, 2.0, 2.0, 0.0, 0.0])
    scene = (
        standing("suitcase", count=8).scene.select(slice(0, 6)).replace(means=positions)
    )
    covered = account(look(0.0), count=6, covered=0.3)
    again = repaired(scene, covered)
    # one of the two is in the mask
    assert again.means[:, 2].tolist() == pytest.approx([-0.1, 0.1, 2.0, 0.0, 0.0])
    assert repaired(scene, account(look(0.0), count=6, covered=0.05)) is scene


def test_the_command_repairs_what_it_finds(
    honest: Made, hiding: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.ply"
    plain = tmp_path / "plain.ply"
    out = tmp_path / "out.ply"
    save_splat(hiding.scene, bad)
    save_splat(honest.scene, plain)
    command = ["audit", str(bad), "--only", "looks", "--repair", str(out)]
    assert cli.main([*command, "--json", "--strict"]) == 3
    repaired = json.loads(capsys.readouterr().out)["repair"]
    assert repaired["verdict"] == "consistent"
    changed = (load_splat(out).sh != load_splat(bad).sh).flatten(1).any(1)
    assert int(changed.sum()) == repaired["coloured_anew"] > 100
    other = tmp_path / "other.spz"
    assert (
        cli.main(["audit", str(plain), "--only", "looks", "--repair", str(other)]) == 0
    )
    assert (
        "nothing was found that could be repaired, and nothing is written"
        in capsys.readouterr().out
    )
    assert not other.exists()


@pytest.mark.parametrize(
    ("words", "says", "status"),
    [
        (["a.ply", "--repair", "a.ply"], "expected another file than the input", 1),
        (["a.ply", "--repair", "b.ply"], "expected a free name", 1),
        (
            ["a.ply", "--against", "b.ply", "--repair", "b.ply", "--force"],
            "another file than the input",
            1,
        ),
        (
            ["old/s.json", "--out", "old", "--force"],
            "--out: expected a folder without the input",
            2,
        ),
        (
            ["a.ply", "--against", "old/s.json", "--out", "old", "--force"],
            "expected a folder without the input",
            2,
        ),
        (
            ["set", "--against", "b.ply"],
            "--against: expected a splat, got the images set",
            2,
        ),
        (
            ["a.ply", "--downscale", "2"],
            "--downscale: expected images with cameras, got a.ply",
            2,
        ),
        (["a.ply", "--keep", "inside"], "--keep: expected --repair beside it", 2),
    ],
)
def test_what_cannot_be_written_is_told_before_the_work(
    words: list[str],
    says: str,
    status: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in (
        "a.ply",
        "b.ply",
        "old/s.json",
        "old/result.json",
        "set/transforms.json",
    ):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_bytes(b"never read")
    assert cli.main(["audit", *words]) == status
    assert says in capsys.readouterr().err
    assert (
        Path("b.ply").read_bytes() == Path("old/s.json").read_bytes() == b"never read"
    )
