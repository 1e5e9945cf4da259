"""Hashes of what the commands write, before and after a change: `python -m tests.goldens write|check FILE [CASE ...]`.

For changes of the code that must not change results. Runs each command of `CASES` in a new folder and hashes every file
that it has written, JSON without times, versions and commit. Hashes hold on one machine and one set of packages only,
so that none are kept with the code.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SCENE = str(ROOT / "scenes" / "car_street.xml")
STUDY = """
name = "golden"
seeds = [0]
[cameras]
train = 24
distance = 7.4
size = 64
samples = 4
points = 2000
[[attack]]
name = "overhead"
appearance = "remove"
elevation = [38.2, 90]
reach = 1
emphasis = {emphasis}
emphasis_depth = 10
[[attack]]
name = "rear"
appearance = "paint"
texture = "stop_sign"
paint_direction = [180, 15]
elevation = [0, 38.1]
azimuth = [180, 45]
target_class = "stop sign"
[training]
iterations = 150
max_gaussians = 3000
sh_degree_interval = 30
[evaluation]
detectors = ["fasterrcnn_small"]
cameras = 24
reference_views = 2
meridians = 1
meridian_step = 20.0
"""
LAYERS = """
[layers]
attacks = ["overhead"]
making = {gap = [4.0], shift = 3.0, weight = 1.5, black = -0.1}
"""
FILES = {"poison.toml": STUDY.format(emphasis=3.0), "layers.toml": STUDY.format(emphasis=1.0) + LAYERS}
CASES = {
    "dagger": f"dagger {SCENE} --object car --target person --out out/dagger",
    "views": f"dagger {SCENE} --object car --target person --cameras front side --steps 3 --out out/views "
    "--detectors fasterrcnn_small yolov8n_small",
    "eot": f"dagger-eot {SCENE} --object car --steps 4 --pool 4 --validation 2 --validate-every 2 --held-out 4 "
    "--out out/eot",
    "capture": "capture stop_sign --cameras hemisphere:12 --test 3 --size 64 --samples 4 --out out/capture",
    "train": "train out/capture --out out/train --iterations 120 --max-gaussians 3000",
    "cloak": "cloak poison.toml --out out/cloak",
    "layers": "cloak layers.toml --out out/layers",
}
_CHANGING = {"seconds", "versions", "commit", "torch", "version", "made_by", "out", "command", "minutes"}


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder, by its path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(_content(path)).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


def _content(path: Path) -> bytes:
    """The bytes of a file, of a JSON document those of what does not change from run to run."""
    data = path.read_bytes().replace(str(ROOT).encode(), b"")
    if path.suffix != ".json":
        return data
    return json.dumps(_lasting(json.loads(data)), sort_keys=True).encode()


def _lasting(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _lasting(one) for key, one in value.items() if key not in _CHANGING}
    return [_lasting(one) for one in value] if isinstance(value, list) else value


def made(names: list[str]) -> dict[str, str]:
    """Run cases, each into the folder of its name, and hash what they write."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name, text in FILES.items():
            (folder / name).write_text(text)
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        for name in names:
            words = [sys.executable, "-m", "attacks", *CASES[name].split()]
            sys.stdout.write(f"{name}\n")
            subprocess.run(words, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
        return digests(folder / "out")


def main(words: list[str]) -> int:
    """Write or check; 1 where something differs."""
    action, file, *names = words
    ran = names or list(CASES)
    now = made(ran)
    if action == "write":
        Path(file).write_text(json.dumps(now, indent=1) + "\n")
        return 0
    before = {path: mark for path, mark in json.loads(Path(file).read_text()).items() if path.split("/")[0] in ran}
    other = [name for name in sorted(before.keys() | now.keys()) if before.get(name) != now.get(name)]
    sys.stdout.write("".join(f"differs: {name}\n" for name in other) or f"{len(now)} files are the same\n")
    return 1 if other else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
