"""Real captures that others published: fetches one and checks every file.

    python -m scenes.recipes.real_captures list
    python -m scenes.recipes.real_captures fetch banana
    python -m scenes.recipes.real_captures fetch doll --from CLONE

`scenes/studies/real/captures.toml` names repository, commit, author and licence of
each, and `checksums.txt` beside it the SHA-256 of each file. Nothing of them is part of
this project: the files come from their repository by git, or from a clone of it.
"""

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
LISTED = ROOT / "scenes" / "studies" / "real" / "captures.toml"
CHECKSUMS = LISTED.with_name("checksums.txt")


class FetchError(Exception):
    """A capture cannot be had, or is not what it was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """One capture of somebody else, as `captures.toml` states it."""

    name: str
    contents: str  # what it shows
    repository: str  # URL that git can fetch from
    commit: str  # 40 hex digits
    author: str
    licence: str  # SPDX identifier, or the name of the licence
    paths: tuple[str, ...]  # files and folders of the repository
    strip: str = ""  # leading folder that the files lose
    poses: str = ""  # a cameras.json of 3DGS, for photographs without other poses
    points: str = ""  # the points of a COLMAP model, as a PLY file
    radial: float = 0.0  # k1 of their SIMPLE_RADIAL lens
    then: tuple[str, ...] = ()  # commands that lead to a splat

    def place_of(self, path: str) -> str:
        """Where a file of the repository lies in the capture's folder."""
        return path.removeprefix(self.strip)


def captures() -> dict[str, Capture]:
    """Every capture by its name."""
    listed = tomllib.loads(LISTED.read_text())
    found = {}
    for name, settings in listed.items():
        settings["paths"] = tuple(settings["paths"])
        settings["then"] = tuple(settings.get("then", ()))
        found[name] = Capture(name=name, **settings)
    return found


def checksums(name: str) -> dict[str, str]:
    """SHA-256 of each file of a capture, by its path in the repository."""
    sums = {}
    for line in CHECKSUMS.read_text().splitlines():
        digest, _, path = line.partition("  ")
        owner, _, inside = path.partition("/")
        if owner == name:
            sums[inside] = digest
    return sums


class Clone:
    """A repository on this machine, whose files are read without a work tree."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def read(self, capture: Capture, path: str) -> bytes:
        """The bytes of one file at the capture's commit."""
        return self._git("cat-file", "blob", f"{capture.commit}:{path}")

    def files(self, capture: Capture) -> list[str]:
        """Every file of the capture's paths."""
        listed = self._git(
            "ls-tree", "-r", "-z", "--name-only", capture.commit, *capture.paths
        )
        return [name.decode() for name in listed.split(b"\0") if name]

    def _git(self, *arguments: str) -> bytes:
        # Somebody else's repository: neither its hooks nor its filters are run by
        # these commands, which read objects only.
        done = subprocess.run(
            ["git", "-C", str(self._folder), *arguments],
            capture_output=True,
            check=False,
        )
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip() or "git failed"
            raise FetchError(f"{self._folder}: {said.splitlines()[-1]}")
        return done.stdout


def download(capture: Capture, folder: Path) -> Clone:
    """Fetch the one commit into a bare repository, with the capture's files."""
    git = ["git", "-C", str(folder)]
    commands = [
        ["git", "init", "-q", "--bare", str(folder)],
        # Files are fetched when they are read, so that a large repository costs no
        # more than its capture.
        [*git, "config", "remote.origin.url", capture.repository],
        [*git, "config", "remote.origin.promisor", "true"],
        [*git, "config", "remote.origin.partialclonefilter", "blob:none"],
        [
            *git,
            *("fetch", "-q", "--depth", "1", "--filter", "blob:none"),
            "origin",
            capture.commit,
        ],
    ]
    for command in commands:
        done = subprocess.run(command, capture_output=True, check=False)
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise FetchError(
                f"{capture.repository} cannot be reached: {said[-1] if said else ''};"
                " pass a clone of it with --from"
            )
    return Clone(folder)


def fetch(capture: Capture, clone: Clone, out: Path) -> None:
    """Write the files of a capture into a new folder, each checked."""
    sums = checksums(capture.name)
    if not sums:
        raise FetchError(f"no checksums of {capture.name} in {CHECKSUMS.name}")
    if out.exists():
        raise FetchError(f"{out} is there already; remove it, or pass another --out")
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".fetch") as made:
        whole = Path(made) / out.name
        for path, digest in sums.items():
            data = clone.read(capture, path)
            found = hashlib.sha256(data).hexdigest()
            if found != digest:
                raise FetchError(
                    f"{path}: expected SHA-256 {digest}, got {found};"
                    f" fetch {capture.repository} at {capture.commit}"
                )
            place = whole / capture.place_of(path)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(data)
        if capture.poses:
            _write_transforms(capture, whole)
        shutil.move(whole, out)


def _write_transforms(capture: Capture, folder: Path) -> None:
    """Poses of a cameras.json of 3DGS as transforms.json, for its original photographs.

    The poses are those of images without distortion; undoing it leaves a camera where
    it was, so they hold for the photographs, too.
    """
    from PIL import Image

    cameras = json.loads((folder / capture.place_of(capture.poses)).read_text())
    photographs = {path.stem: path for path in sorted(folder.rglob("*.jpg"))}
    first = next(iter(photographs.values()))
    with Image.open(first) as image:
        width, height = image.size
    frames = []
    for camera in sorted(cameras, key=lambda record: str(record["img_name"])):
        to_world = np.eye(4)
        to_world[:3, :3] = camera["rotation"]
        to_world[:3, 3] = camera["position"]
        # from x right, y down, z forward to x right, y up, z backward
        to_world[:, 1:3] *= -1
        frames.append(
            {
                "file_path": str(
                    photographs[camera["img_name"]].relative_to(folder).as_posix()
                ),
                "transform_matrix": to_world.tolist(),
            }
        )
    document = {
        "camera_model": "SIMPLE_RADIAL",
        "w": width,
        "h": height,
        "fl_x": cameras[0]["fx"],
        "fl_y": cameras[0]["fx"],
        "cx": width / 2,
        "cy": height / 2,
        "k1": capture.radial,
        "ply_file_path": capture.place_of(capture.points),
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(document, indent=1))


def _sums(capture: Capture, clone: Clone) -> Iterator[str]:
    """Lines of `checksums.txt`, for who adds a capture."""
    for path in clone.files(capture):
        digest = hashlib.sha256(clone.read(capture, path)).hexdigest()
        yield f"{digest}  {capture.name}/{path}"


def write(line: str) -> None:
    """A line on stdout."""
    sys.stdout.write(line + "\n")


def _list() -> None:
    for capture in captures().values():
        files = len(checksums(capture.name))
        write(f"{capture.name:8} {capture.contents} ({files} files)")
        write(f"{'':8} {capture.author}, {capture.licence}: {capture.repository}")


def get(capture: Capture, clone: Path | None, out: Path) -> None:
    """Fetch a capture from a clone, or from its repository, into a new folder."""
    with tempfile.TemporaryDirectory() as folder:
        source = Clone(clone) if clone else download(capture, Path(folder))
        fetch(capture, source, out)


def _say(capture: Capture, out: Path) -> None:
    write(f"{out}: {capture.contents}, by {capture.author} ({capture.licence})")
    for command in capture.then:
        write("  " + command.format(folder=out))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    kinds = parser.add_subparsers(dest="command", required=True)
    kinds.add_parser("list", help="the captures, with author and licence")
    one = kinds.add_parser("fetch", help="get the files of one, and check them")
    sums = kinds.add_parser("checksums", help="print the lines of checksums.txt")
    for kind in (one, sums):
        kind.add_argument("name", choices=sorted(captures()))
        kind.add_argument(
            "--from",
            dest="clone",
            type=Path,
            metavar="CLONE",
            required=kind is sums,
            help="a clone of its repository, where the network does not reach it",
        )
    one.add_argument(
        "--out", type=Path, metavar="FOLDER", help="default: out/captures/NAME"
    )
    asked = parser.parse_args()
    if asked.command == "list":
        return _list()
    capture = captures()[asked.name]
    try:
        if asked.command == "checksums":
            write("\n".join(_sums(capture, Clone(asked.clone))))
        else:
            out = asked.out or Path("out/captures") / asked.name
            get(capture, asked.clone, out)
            _say(capture, out)
    except FetchError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
