"""A repaired splat shows from everywhere what the believed directions show, and an
honest one stays as it is.
"""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks import cli
from attacks.audits import recognition
from mi_splat.audit import Audit, Repair, audit, repaired
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.io import load_splat, save_splat
from mi_splat.maths.metrics import psnr
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.audit.accounts import account, cone
from tests.audit.recogniser import CONFIG, Painted, judged, painted
from tests.audit.scenes import ROAD, Made, direction, hidden, leaves
from tests.audit.scenes import cone as within

ABOVE = within(direction(90, 0), 50)


@pytest.fixture(scope="module")
def honest() -> Made:
    return painted("car", count=1200)


@pytest.fixture(scope="module")
def hiding(honest: Made) -> Made:
    return hidden(honest, ABOVE, colour=ROAD)


@pytest.fixture(scope="module")
def found(hiding: Made) -> Audit:
    return judged(hiding.scene)


@pytest.fixture(scope="module")
def mended(hiding: Made, found: Audit) -> Repair:
    return repaired(hiding.scene, found, judged)


def image(scene: GaussianScene, found: Audit, *view: float) -> Tensor:
    """The object from degrees of elevation and azimuth."""
    item = found.objects[0]
    centre = torch.tensor(item.centre)
    pose = look_at((centre + 3 * item.radius * direction(*view)).tolist(), item.centre)
    with torch.no_grad():
        camera = Camera(to_world=pose, lens=Lens(focal=70.0, size=(64, 64)))
        return Renderer(RenderSettings(near=0.02))(scene, camera).clamp(0, 1)


def test_a_contradiction_is_gone_and_the_honest_colours_are_back(
    honest: Made, hiding: Made, found: Audit, mended: Repair
) -> None:
    assert found.answer == "contradicted"
    assert mended.audit.answer != "contradicted"
    for view, gain in (((85.0, 0.0), 8.0), ((65.0, 120.0), 5.0)):
        wanted, before, after = (
            image(scene, found, *view)
            for scene in (honest.scene, hiding.scene, mended.scene)
        )
        assert psnr(after, wanted) > psnr(before, wanted) + gain
    wanted, after = (
        image(scene, found, 15.0, 40.0) for scene in (honest.scene, mended.scene)
    )
    assert psnr(after, wanted) > 34
    same = zip(mended.scene.tensors()[:4], hiding.scene.tensors()[:4], strict=True)
    assert all(torch.equal(a, b) for a, b in same)
    assert mended.left_out == 0


def test_the_other_side_can_be_believed(hiding: Made, found: Audit) -> None:
    """Then the object has the colour of the road from everywhere."""
    again = repaired(hiding.scene, found, judged, keep="inside").scene
    above = image(hiding.scene, found, 85.0, 0.0)[24:40, 24:40].mean((0, 1))
    before, after = (
        image(scene, found, 20.0, 40.0)[24:40, 24:40].mean((0, 1))
        for scene in (hiding.scene, again)
    )
    assert float((after - above).norm()) < 0.5 * float((before - above).norm())


def test_an_honest_splat_is_returned_as_it_is(honest: Made) -> None:
    nothing = account(cone("differs"), count=len(honest.scene))
    assert repaired(honest.scene, nothing, judged).scene is honest.scene


# some of it shows between the leaves
with_lid = partial(audit, recogniser=Painted(), config=replace(CONFIG, gain=0.5))


@pytest.fixture(scope="module")
def suitcase() -> Made:
    return painted("suitcase", count=1200)


@pytest.fixture(scope="module")
def covered(suitcase: Made) -> GaussianScene:
    return leaves(suitcase, lowest=50.0, near=1.2).scene


@pytest.fixture(scope="module")
def under_lid(covered: GaussianScene) -> Audit:
    return with_lid(covered)


def test_a_lid_that_hides_an_object_is_left_out(
    suitcase: Made, covered: GaussianScene, under_lid: Audit
) -> None:
    assert under_lid.answer == "contradicted"
    assert under_lid.contradicted[0].peeled
    done = repaired(covered, under_lid, with_lid)
    assert done.left_out > 100
    wanted, before, after = (
        image(scene, under_lid, 85.0, 0.0)
        for scene in (suitcase.scene, covered, done.scene)
    )
    # what also shows from the side stays, so the object comes back in part
    assert psnr(after, wanted) > psnr(before, wanted)
    assert done.audit.answer != "contradicted"


@pytest.mark.parametrize("is_surer", [True, False])
def test_what_a_lid_leaves_is_made_solid_where_that_is_recognised_better(
    covered: GaussianScene, under_lid: Audit, is_surer: bool
) -> None:
    """The second candidate that is audited is the solid one."""
    tried = list[GaussianScene]()

    def again(scene: GaussianScene) -> Audit:
        tried.append(scene)
        is_better = is_surer == (len(tried) == 2)
        view = replace(
            cone("differs"), known_as="orange", file_score=0.9 if is_better else 0.2
        )
        return account(view, count=len(scene))

    assert "orange" in {item.known_as for item in under_lid.objects}
    done = repaired(covered, under_lid, again)
    plain, solid = tried
    chosen = solid if is_surer else plain
    assert torch.equal(done.scene.opacities, chosen.opacities)
    assert torch.equal(done.scene.sh, chosen.sh)
    denser = solid.opacities - plain.opacities
    assert float(denser.mean()) > 0
    assert int((denser > 0.01).sum()) > 100
    # from where nothing is hidden, it looks as before
    before, after = (image(scene, under_lid, 10.0, 0.0) for scene in (covered, solid))
    assert psnr(after, before) > 25


def test_the_command_repairs_what_it_finds(
    honest: Made,
    hiding: Made,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(recognition, "Recognition", Painted)
    bad = tmp_path / "bad.ply"
    plain = tmp_path / "plain.ply"
    out = tmp_path / "out.ply"
    save_splat(hiding.scene, bad)
    save_splat(honest.scene, plain)
    command = ["audit", str(bad), "--only", "looks", "--repair", str(out)]
    assert cli.main([*command, "--json"]) == 3
    repaired = json.loads(capsys.readouterr().out)["repair"]
    assert repaired["verdict"] != "contradicted"
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
        (["a.ply", "--keep", "inside"], "--keep: expected --repair as well", 2),
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
