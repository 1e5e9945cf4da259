"""What an error says fits Python and the command line; only the command line adds the names of its flags."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from attacks import cli
from attacks.observe.comparison import changed_mask
from mi_splat.errors import MiSplatError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.errors import SplatFileWarning
from mi_splat.io.folders import check_new_folder
from mi_splat.scene import GaussianScene
from mi_splat.selection.config import Selection
from mi_splat.selection.select import select
from tests.fakes import toy_scene


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    scene = toy_scene()[0]
    save_splat(scene, tmp_path / "a.ply")
    text = (tmp_path / "a.ply").read_bytes()
    body = text.index(b"end_header\n") + len(b"end_header\n")
    (tmp_path / "nan.ply").write_bytes(text[:body] + torch.tensor([float("nan")]).numpy().tobytes() + text[body + 4 :])
    (tmp_path / "page.html").write_text("old")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def scene() -> GaussianScene:
    return toy_scene()[0]


CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "nothing selected": (lambda: select(scene(), Selection()), "--box"),
    "none selected": (lambda: select(scene(), Selection(box=(8, 8, 8, 9, 9, 9))), "--box"),
    "no such part": (lambda: select(scene(), Selection(object="car")), "--object"),
    "an older result": (lambda: check_new_folder("out", force=False), "--force"),
    "two of the same": (lambda: changed_mask(scene(), scene()), "--box"),
    "a NaN": (lambda: load_splat("nan.ply"), "mi-splat convert nan.ply VALID.ply --drop-invalid"),
}


@pytest.mark.parametrize("name", CALLS)
def test_python_hears_of_no_flags(name: str, folder: Path) -> None:
    call, hint = CALLS[name]
    with pytest.raises(MiSplatError) as caught:
        call()
    assert re.search(r"(^|\W)--\w", str(caught.value)) is None
    assert hint in caught.value.hint


@pytest.mark.parametrize("words", [["render", "nan.ply"], ["select", "nan.ply", "--cluster", "1"]])
def test_the_command_line_says_how_to_drop_what_is_not_valid(
    words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 1
    error = capsys.readouterr().err
    assert "(mi-splat convert nan.ply VALID.ply --drop-invalid)" in error
    assert len(error.splitlines()) == 1
    with pytest.warns(SplatFileWarning, match="left out"):
        assert cli.main(["convert", "nan.ply", "VALID.ply", "--drop-invalid"]) == 0
    assert os.path.exists("VALID.ply")
