"""A bounded copy: no direction departs from the consensus by more than its bound, which
anybody can check by the file alone.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from attacks import cli
from mi_splat.audit import bounded, colour_bound
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.maths.sh import dc_to_colour, even_directions, sh_basis
from mi_splat.scene import GaussianScene
from tests.audit import scenes
from tests.audit.scenes import Made, cone, direction, hidden, standing

EPS = 0.05


@pytest.fixture(scope="module")
def poisoned() -> Made:
    suitcase = standing("suitcase", count=600)
    region = cone(direction(90, 0), 45.0)
    return hidden(suitcase, region, colour=(0.8, 0.2, 0.1))


def departure(scene: GaussianScene) -> Tensor:
    """(N,) how far a colour departs from that of band 0, over many directions."""
    ways = torch.from_numpy(even_directions(2000))
    sh = scene.sh.double()
    sh[:, 0] = 0.0
    return (
        torch.einsum("dk,nkc->ndc", sh_basis(ways, scene.degree), sh).abs().amax((1, 2))
    )


def test_no_direction_departs_further_than_the_bound(poisoned: Made) -> None:
    scene = poisoned.scene
    assert float(departure(scene).max()) > 4 * EPS
    assert bool((departure(scene) <= colour_bound(scene) + 1e-6).all())
    done = bounded(scene, EPS)
    assert float(colour_bound(done.scene).max()) <= EPS
    assert float(departure(done.scene).max()) <= EPS
    assert float(departure(done.scene).max()) > 0.5 * EPS


def test_the_bound_is_reached_by_a_band_that_points_one_way() -> None:
    """The addition theorem is tight: in the direction whose own basis the coefficients
    are, the departure is the bound.
    """
    way = torch.from_numpy(even_directions(7))[3]
    sh = torch.zeros(1, 16, 3)
    sh[0, 9:, :] = 0.3 * sh_basis(way, 3)[9:, None].float()
    scene = standing("suitcase", count=20).scene.select(slice(0, 1)).replace(sh=sh)
    reached = (sh_basis(way, 3)[9:] @ sh[0, 9:].double()).abs().max()
    assert float(colour_bound(scene)[0]) == pytest.approx(float(reached), rel=1e-6)


def test_what_is_within_the_bound_stays_to_the_bit(poisoned: Made) -> None:
    scene = poisoned.scene
    calm = colour_bound(scene) <= EPS
    assert 0 < int(calm.sum()) < len(scene)
    done = bounded(scene, EPS)
    assert torch.equal(done.scene.sh[calm], scene.sh[calm])
    assert torch.equal(done.changed, ~calm)
    for before, after in zip(
        scene.tensors()[:4], done.scene.tensors()[:4], strict=True
    ):
        assert torch.equal(before, after)
    loose = bounded(scene, 100.0)
    assert torch.equal(loose.scene.sh, scene.sh)
    assert min(loose.psnr) == float("inf")


def test_the_consensus_is_what_most_cameras_see(poisoned: Made) -> None:
    """The suitcase hides red from above; the copy is not redder than the suitcase."""
    plain = standing("suitcase", count=600).scene
    done = bounded(poisoned.scene, EPS).scene
    rows = poisoned.rows
    colours = [dc_to_colour(scene.sh[rows, 0]) for scene in (done, plain)]
    gap = (colours[0] - colours[1]).abs().mean(1)
    assert float(gap.median()) < 0.1


def test_an_object_may_keep_its_gloss(poisoned: Made) -> None:
    keep = torch.zeros(len(poisoned.scene), dtype=torch.bool)
    keep[poisoned.rows.nonzero()[:50, 0]] = True
    reach = colour_bound(bounded(poisoned.scene, EPS, keep=keep, keep_eps=0.3).scene)
    assert float(reach[~keep].max()) <= EPS
    assert EPS < float(reach[keep].max()) <= 0.3


@pytest.mark.parametrize("eps", [0.0, -1.0, float("nan")])
def test_no_bound_is_refused(poisoned: Made, eps: float) -> None:
    with pytest.raises(InvalidValueError, match="eps: expected more than 0"):
        bounded(poisoned.scene, eps)


def test_a_mask_of_another_splat_is_refused(poisoned: Made) -> None:
    with pytest.raises(InvalidValueError, match="keep: expected bool"):
        bounded(poisoned.scene, keep=torch.ones(3, dtype=torch.bool))


def test_the_command_certifies_a_copy_and_checks_it(
    poisoned: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "a.ply"
    safe = tmp_path / "safe.ply"
    save_splat(poisoned.scene, source)
    assert cli.main(["bound", str(source), "--out", str(safe)]) == 0
    said = capsys.readouterr().out
    assert "no colour departs by more than 0.0500 of 0.05 in any direction" in said
    assert "price: " in said
    certificate = json.loads((tmp_path / "safe.ply.bound.json").read_text())
    assert certificate["beyond"] == 0
    assert certificate["bound"] <= EPS
    assert certificate["price"]["psnr_lowest"] > 10
    assert cli.main(["bound", str(safe), "--verify"]) == 0
    assert cli.main(["bound", str(source), "--verify"]) == 3
    assert "depart by more than 0.05" in capsys.readouterr().out
    save_splat(load_splat(safe).replace(means=load_splat(safe).means + 1), safe)
    assert cli.main(["bound", str(safe), "--verify"]) == 3
    assert "the certificate belongs to another file" in capsys.readouterr().out
    assert cli.main(["bound", str(source), "--out", str(safe)]) == 1
    assert cli.main(["bound", str(source)]) == 2


def test_the_command_keeps_an_object(poisoned: Made, tmp_path: Path) -> None:
    source = tmp_path / "a.ply"
    save_splat(poisoned.scene, source)
    np.save(tmp_path / "mask.npy", poisoned.rows.numpy())
    words = ["--keep", str(tmp_path / "mask.npy"), "--keep-eps", "0.4"]
    words += ["--cameras", "orbit:9@30"]
    out = str(tmp_path / "safe.ply")
    assert cli.main(["bound", str(source), "--out", out, *words]) == 0
    certificate = json.loads((tmp_path / "safe.ply.bound.json").read_text())
    assert 0 < certificate["beyond"] <= int(poisoned.rows.sum())
    assert certificate["largest"] <= 0.4
    assert certificate["price"]["cameras"] == 9
    assert cli.main(["bound", out, "--verify"]) == 0


def test_a_glossy_splat_pays_more_than_a_matt_one() -> None:
    matt = standing("suitcase", count=400)
    glossy = scenes.glossy(matt)
    assert min(bounded(glossy.scene, EPS).psnr) < min(bounded(matt.scene, EPS).psnr)
