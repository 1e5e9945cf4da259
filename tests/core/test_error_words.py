"""What an error says fits Python and the command line; only the command line adds the
names of its flags.
"""

import json
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
    (tmp_path / "nan.ply").write_bytes(
        text[:body] + torch.tensor([float("nan")]).numpy().tobytes() + text[body + 4 :]
    )
    (tmp_path / "page.html").write_text("old")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def scene() -> GaussianScene:
    return toy_scene()[0]


CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "nothing selected": (lambda: select(scene(), Selection()), "--box"),
    "none selected": (
        lambda: select(scene(), Selection(box=(8, 8, 8, 9, 9, 9))),
        "--box",
    ),
    "no such part": (lambda: select(scene(), Selection(object="car")), "--object"),
    "an older result": (lambda: check_new_folder("out", force=False), "--force"),
    "two of the same": (lambda: changed_mask(scene(), scene()), "--box"),
    "a NaN": (
        lambda: load_splat("nan.ply"),
        "mi-splat convert nan.ply VALID.ply --drop-invalid",
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_python_hears_of_no_flags(name: str, folder: Path) -> None:
    call, hint = CALLS[name]
    with pytest.raises(MiSplatError) as caught:
        call()
    assert re.search(r"(^|\W)--\w", str(caught.value)) is None
    assert hint in caught.value.hint


@pytest.mark.parametrize(
    "words", [["render", "nan.ply"], ["select", "nan.ply", "--cluster", "1"]]
)
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


def test_what_a_foreign_file_holds_is_not_repeated_whole(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = "k" * 70_000
    (folder / "policy.toml").write_text(f'{key} = "accept"\n')
    (folder / "rules.toml").write_text(f'[rules]\n{key} = "accept"\n')
    (folder / "study.toml").write_text(f'study = "{key}"\n')
    (folder / "config.json").write_text(json.dumps({key: 1}))
    for words in (
        ["gate", "a.ply", "--policy", "policy.toml"],
        ["gate", "a.ply", "--policy", "rules.toml"],
        ["study", "plan", "study.toml"],
        ["render", "a.ply", "--cameras", f"a.ply#{key}"],
        ["info", f"{key[:5000]}.ply"],
        ["render", "a.ply", "--out", key[:5000]],
        ["audit", "a.ply", "--only", "lint", "--out", f"new/{key[:5000]}"],
        [key],
    ):
        assert cli.main(words) in (1, 2)
        error = capsys.readouterr().err
        assert len(error) < 2000, (words[:2], len(error))
        assert len(error.splitlines()) == 1
    assert not (folder / "new").exists()


def test_a_name_that_is_too_long_has_a_remedy(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (
        ["info", f"{'a' * 300}.ply"],
        ["detect", f"{'a' * 300}.png"],
        ["render", "a.ply", "--out", "a" * 300],
    ):
        assert cli.main(words) == 1
        assert "File name too long; use a shorter name" in capsys.readouterr().err


def test_a_lack_of_memory_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for error in (
        MemoryError(),
        ImportError("libtorch.so: failed to map segment from shared object"),
    ):
        monkeypatch.setattr(cli, "_dispatch", raiser(error))
        assert cli.main(["info", "a.ply"]) == 1
        assert (
            "memory: expected enough memory for this command" in capsys.readouterr().err
        )
    monkeypatch.setattr(cli, "_dispatch", raiser(ImportError("no module of this name")))
    with pytest.raises(ImportError, match="no module"):
        cli.main(["info", "a.ply"])


def raiser(error: Exception) -> Callable[[object], int]:
    def fail(_: object) -> int:
        raise error

    return fail
