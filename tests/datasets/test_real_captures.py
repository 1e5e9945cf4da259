"""Captures of others, fetched from a repository and checked."""

import hashlib
import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mi_splat.datasets import load_dataset
from scenes.recipes import real_captures
from scenes.recipes.real_captures import Capture, Clone, FetchError, download, fetch

POSE = np.array(
    [
        [1.0, 0.0, 0.0, 0.5],
        [0.0, 0.0, 1.0, -3.0],
        [0.0, -1.0, 0.0, 1.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Camera to world, x right, y down, z forward: it looks along +y, and z is up."""


def git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    done = subprocess.run([*command, *arguments], capture_output=True, check=True)
    return done.stdout.decode().strip()


@pytest.fixture
def capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Capture:
    """Two photographs and their poses, committed to a repository."""
    clone = tmp_path / "clone"
    (clone / "data/images").mkdir(parents=True)
    records = []
    for name in ("one", "two"):
        photograph = Image.new("RGB", (40, 30), (200, 100, 50))
        photograph.save(clone / f"data/images/{name}.jpg")
        record = {"img_name": name, "fx": 35.0, "fy": 35.0}
        rotation = POSE[:3, :3].tolist()
        records.append(
            {**record, "rotation": rotation, "position": POSE[:3, 3].tolist()}
        )
    (clone / "data/cameras.json").write_text(json.dumps(records))
    git(clone, "init", "-q")
    git(clone, "config", "uploadpack.allowAnySHA1InWant", "true")
    git(clone, "config", "uploadpack.allowFilter", "true")
    git(clone, "add", ".")
    git(clone, "commit", "-q", "-m", "a capture")
    lines = [
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}"
        f"  toy/{path.relative_to(clone).as_posix()}\n"
        for path in sorted((clone / "data").rglob("*.*"))
    ]
    sums = tmp_path / "checksums.txt"
    sums.write_text("".join(lines))
    monkeypatch.setattr(real_captures, "CHECKSUMS", sums)
    return Capture(
        name="toy",
        contents="two photographs",
        repository=clone.as_uri(),
        commit=git(clone, "rev-parse", "HEAD"),
        author="somebody",
        licence="MIT",
        paths=("data",),
        strip="data/",
        poses="data/cameras.json",
        radial=0.01,
    )


def test_a_fetched_capture_is_a_set(capture: Capture, tmp_path: Path) -> None:
    out = tmp_path / "out"
    fetch(capture, Clone(tmp_path / "clone"), out)
    views = load_dataset(out, split=None)
    assert len(views) == 2
    position = views.cameras[0].to_world
    assert np.allclose(position, POSE, atol=1e-6)
    with pytest.raises(FetchError, match="is there already"):
        fetch(capture, Clone(tmp_path / "clone"), out)


def test_the_files_come_by_git_where_there_is_no_clone(
    capture: Capture, tmp_path: Path
) -> None:
    clone = download(capture, tmp_path / "bare")
    assert clone.files(capture) == [
        "data/cameras.json",
        "data/images/one.jpg",
        "data/images/two.jpg",
    ]
    fetch(capture, clone, tmp_path / "out")
    assert (tmp_path / "out/images/two.jpg").is_file()


def test_a_repository_out_of_reach_is_one_sentence(
    capture: Capture, tmp_path: Path
) -> None:
    missing = replace(capture, repository=(tmp_path / "missing").as_uri())
    with pytest.raises(FetchError, match=r"cannot be reached.*--from"):
        download(missing, tmp_path / "bare")


def test_a_changed_file_is_refused_and_nothing_is_written(
    capture: Capture, tmp_path: Path
) -> None:
    sums = real_captures.CHECKSUMS
    lines = sums.read_text().splitlines()
    lines[-1] = f"{'0' * 64}  toy/data/images/two.jpg"
    sums.write_text("\n".join(lines) + "\n")
    with pytest.raises(FetchError, match=r"two\.jpg: expected SHA-256 0{64}"):
        fetch(capture, Clone(tmp_path / "clone"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".fetch*"))


def test_every_listed_capture_states_its_source() -> None:
    for capture in real_captures.captures().values():
        assert capture.author
        assert capture.licence
        assert len(capture.commit) == 40
        inside = real_captures.checksums(capture.name)
        assert inside, capture.name
        assert all(path.startswith(capture.paths) for path in inside)
