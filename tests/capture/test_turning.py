"""`mi-splat capture`: what is around a mesh, the near clip; other options are told
apart.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from attacks import cli
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.capture.settings import SurroundingsSettings
from mi_splat.capture.sources import open_source
from mi_splat.datasets import load_dataset
from tests.capture.trucks import truck, write_glb


def picture(source: Any, *, size: int = 32) -> Tensor:
    (camera,) = orbit(
        source.centre,
        count=1,
        elevation=35,
        distance=8.0,
        lens=Lens(focal=size, size=(size, size)),
    )
    return PathTracer(source.scene, samples=16).picture(camera, seed=0)


def test_ground_and_sun_show(tmp_path: Path) -> None:
    path = str(write_glb(tmp_path, truck()))
    plain = picture(open_source(path))
    for kind, brightest in (("road", None), ("grass", 1)):
        shown = picture(
            open_source(path, surroundings=SurroundingsSettings(ground=kind))  # type: ignore[arg-type]
        )
        assert (shown - plain)[-4:].abs().mean() > 0.03
        if brightest is not None:
            assert int(shown[-4:].mean((0, 1)).argmax()) == brightest
    front, back = (
        picture(
            open_source(path, surroundings=SurroundingsSettings(sun=f"{azimuth},20"))
        )
        for azimuth in (0, 180)
    )
    # its front, seen from azimuth 0
    assert front[20:25, 12:20].mean() > back[20:25, 12:20].mean() + 0.02


def command(folder: Path, path: str, *more: str) -> list[str]:
    quick = [
        "--cameras",
        "orbit:2@20",
        "--size",
        "16",
        "--samples",
        "1",
        "--points",
        "50",
    ]
    return ["capture", path, "--out", str(folder / "out"), *quick, *more]


def test_near_cuts_what_is_near(tmp_path: Path) -> None:
    path = str(write_glb(tmp_path, truck()))
    assert cli.main(command(tmp_path, path, "--rgba", "--near", "7")) == 0
    cut = load_dataset(tmp_path / "out").alpha(0)
    assert cli.main(command(tmp_path / "b", path, "--rgba")) == 0
    whole = load_dataset(tmp_path / "b" / "out").alpha(0)
    assert cut is not None
    assert whole is not None
    assert 0 < float(cut.sum()) < float(whole.sum())


OPTIONS: dict[str, tuple[list[str], str]] = {
    "up": (["--up", "z"], "up None, now 'z'"),
    "ground": (["--ground", "road"], "ground 'none', now 'road'"),
    "near": (["--near", "0.5"], "near None, now 0.5"),
    "cameras": (["--cameras", "orbit:2@30"], "cameras 'orbit:2@20', now 'orbit:2@30'"),
    "distance": (["--distance", "9"], "distance None, now 9.0"),
}


def test_what_differs_is_said_in_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(write_glb(tmp_path, truck()))
    first = command(tmp_path, path)
    assert cli.main(first) == 0
    for words, says in OPTIONS.values():
        capsys.readouterr()
        assert cli.main(command(tmp_path, path, *words)) == 1
        error = capsys.readouterr().err
        assert f"got {says};" in error, error  # this, and nothing else
        assert len(error.splitlines()) == 1
    assert cli.main([*first, "--json"]) == 0
    done = json.loads(capsys.readouterr().out)
    assert (done["rendered"], done["warnings"]) == (0, [])
    record = json.loads((tmp_path / "out" / "capture.json").read_text())
    assert record["inputs"]["scene"]["scene"] == path
    write_glb(tmp_path, truck().placed(scale=1.01))
    assert cli.main(first) == 1
    assert "another scene (what its files hold)" in capsys.readouterr().err
