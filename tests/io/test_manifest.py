"""Every file of a result is in its manifest, and a manifest of strangers leads nowhere else."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from mi_splat.errors import InvalidValueError
from mi_splat.io.folders import new_folder
from mi_splat.io.manifest import MANIFEST, files_in, read_manifest, write_manifest

DIGEST = hashlib.sha256(b"x").hexdigest()


def test_a_folder_of_results_has_a_manifest_of_all_its_files(tmp_path: Path) -> None:
    with new_folder(tmp_path / "out") as folder:
        (folder / "result.json").write_text("x")
        (folder / "pictures").mkdir()
        (folder / "pictures" / "één a.png").write_text("x")
    manifest = read_manifest(tmp_path / "out")
    assert manifest.files == {"pictures/één a.png": (DIGEST, 1), "result.json": (DIGEST, 1)}
    assert manifest.sha256 == hashlib.sha256((tmp_path / "out" / MANIFEST).read_bytes()).hexdigest()


def test_folders_that_are_no_part_are_left_out_and_links_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "big.ply").write_text("x")
    (tmp_path / "a.txt").write_text("x")
    assert write_manifest(tmp_path, without=("stages",)) == write_manifest(tmp_path, without=("stages",))
    assert read_manifest(tmp_path).files.keys() == {"a.txt"}
    assert read_manifest(tmp_path).without == ("stages",)
    (tmp_path / "link").symlink_to(tmp_path / "stages")
    assert [name for name, _ in files_in(tmp_path, ("stages",))] == ["a.txt", "link"]


@pytest.mark.parametrize(
    "name", ["../outside", "/etc/passwd", "a/../../x", ".hidden", "C:\\x", "a/b/c/d/e/f/g", "", "a\n"]
)
def test_names_that_lead_elsewhere_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text(json.dumps({"without": [], "files": {name: {"sha256": DIGEST, "bytes": 1}}}))
    with pytest.raises(InvalidValueError, match="expected names of files in its folder"):
        read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "Expecting value"),
        ("{}", "files, and folders without"),
        ('{"files": [], "without": []}', "files, and folders without"),
        ('{"files": {"a": 3}, "without": []}', "sha256 and bytes of a"),
        ('{"files": {"a": {"sha256": "0", "bytes": 1}}, "without": []}', "sha256 and bytes of a"),
        (f'{{"files": {{"a": {{"sha256": "{DIGEST}", "bytes": -1}}}}, "without": []}}', "sha256 and bytes of a"),
    ],
)
def test_a_broken_manifest_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(InvalidValueError, match="get the result again") as error:
        read_manifest(tmp_path)
    assert said in str(error.value)
