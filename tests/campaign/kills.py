"""Long commands on tiny inputs, killed at a moment that is drawn, and what they may
leave behind.
"""

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random

from attacks.observe.rows import read_rows
from attacks.report.checking import check_files
from mi_splat.errors import MiSplatError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.documents import is_temporary
from mi_splat.io.folders import MANIFEST
from mi_splat.io.picture_files import load_picture
from mi_splat.processes import TERMINATED
from mi_splat.selection.select import load_array
from mi_splat.training.resume import load_state
from tests.fakes import toy_scene
from tests.project.layers import ROOT
from tests.studies.toy import write_toy
from tests.training.sets import write_set
from tests.warm import Warm

MARK = "MI_SPLAT_KILLED"
"""Variable that all processes of a trial have."""
_PATIENCE = 5.0
"""Seconds in which what a killed command has started ends, too."""
_COMPARISON = """study = "compare"
question = "How far are the renderers apart?"
scene = "{scene}"
methods = ["tile", "ray"]
"""
_CLOAK = """name = "tiny"
[cameras]
train = 8
size = 24
samples = 1
points = 300
distance = 7.4
[[attack]]
name = "overhead"
elevation = [38.2, 90]
[training]
iterations = 20
strategy = "fixed"
sh_degree_interval = 0
[evaluation]
detectors = ["fasterrcnn_small"]
cameras = 8
reference_views = 1
meridians = 1
meridian_step = 45.0
"""


def write_inputs(folder: Path) -> None:
    """What all commands read."""
    write_toy(folder)
    write_set(folder / "set")
    scene = toy_scene()[0]
    save_splat(scene, folder / "a.ply")
    save_splat(scene.replace(sh=scene.sh * 0.5), folder / "b.ply")
    (folder / "compare.toml").write_text(_COMPARISON.format(scene=folder / "toy.xml"))
    (folder / "cloak.toml").write_text(_CLOAK)


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        words: Its words; those that begin with @ are names of inputs.
        goes_on: Whether it goes on with what a killed run has left, and so needs no
            --force.
    """

    words: tuple[str, ...]
    goes_on: bool = False

    def line(self, inputs: Path) -> list[str]:
        return [
            str(inputs / word[1:]) if word.startswith("@") else word
            for word in self.words
        ]


def _command(text: str, *, goes_on: bool = False) -> Command:
    return Command(tuple(text.split()), goes_on)


_TOY_VIEW = "--size 32 --distance 3"
_STILL_LIFE = ROOT / "scenes" / "meshes" / "still_life.xml"
COMMANDS: dict[str, Command] = {
    "render": _command("render @toy.xml --cameras all --out rendered"),
    "convert": _command("convert @a.ply converted.spz"),
    "select": _command("select @a.ply --cluster 1 --out picked.png mask.npy"),
    "capture": _command(
        f"capture {_STILL_LIFE} --cameras cap:3@40 --size 16 --samples 2 --points 200"
        " --out captured",
        goes_on=True,
    ),
    "train": _command(
        "train @set --out trained --iterations 60 --sh-degree 1", goes_on=True
    ),
    "poison": _command("poison @set --kind uniform-noise --eps 16 --out poisoned"),
    "dagger": _command(
        "dagger @toy.xml --object car --target person --steps 2 --noise-draws 1 --out"
        " attacked"
    ),
    "evaluate": _command(
        f"evaluate @a.ply @b.ply --cameras orbit:2@0 {_TOY_VIEW} --target person --out"
        " judged"
    ),
    "compare": _command(
        "compare @toy.xml --methods tile,ray --cameras all --out compared"
    ),
    "audit": _command("audit @a.ply --out audited"),
    "gate": _command("gate @a.ply @b.ply --store verdicts", goes_on=True),
    "study": _command(
        "study run @compare.toml --store store --out study --workers 1", goes_on=True
    ),
    "study in this process": _command(
        "study run @compare.toml --store store --out study --workers 0", goes_on=True
    ),
    "cloak": _command("cloak @cloak.toml --out cloaked --workers 0", goes_on=True),
}
"""The long commands by their names."""
SHORT = ("convert", "capture")
"""Those that an everyday test can wait for."""


def trial(
    name: str, inputs: Path, folder: Path, random: Random, longest: float, warm: Warm
) -> list[str]:
    """Kill a command, look at what it left, and run it again; what was wrong, in words.

    Args:
        name: That of the command.
        inputs: Where what it reads is.
        folder: An empty working folder.
        random: Draws the signal and the moment.
        longest: Seconds that the whole command takes.
        warm: Runs it.
    """
    command = COMMANDS[name]
    number = random.choice((signal.SIGKILL, signal.SIGTERM))
    seconds = random.uniform(0.0, longest)
    line = ["-m", "attacks", *command.line(inputs)]
    done = warm.run(*line, cwd=folder, kill=(seconds, number), mark=(MARK, str(folder)))
    faults = [f"processes are left: {left}"] if (left := _left(folder)) else []
    faults += _endings(number, done.returncode, done.stderr)
    faults += half_written(folder)
    faults += _again(command, line, folder, warm)
    faults += half_written(folder)
    if not faults:
        return []
    moment = f"{name} killed by {number.name} after {seconds:.3f} s"
    return [f"{moment}: {fault}" for fault in faults]


def _endings(number: signal.Signals, status: int, said: str) -> list[str]:
    """What is wrong with how a killed command ended; by SIGTERM, it ends itself once it
    can.
    """
    faults = []
    allowed = (0, -number) if number == signal.SIGKILL else (0, -number, TERMINATED)
    if status not in allowed:
        faults.append(f"it ended with {status}: {said[-500:]}")
    if "Traceback" in said:
        faults.append(f"it ended with a traceback: {said[-1500:]}")
    return faults


def _again(
    command: Command, line: Sequence[str], folder: Path, warm: Warm
) -> list[str]:
    """What is wrong with a second run, and then one with --force where it says that
    there is something already.
    """
    done = warm.run(*line, cwd=folder)
    if done.returncode and not command.goes_on and "--force" in done.stderr:
        done = warm.run(*line, "--force", cwd=folder)
    if done.returncode:
        return [f"a second run ended with {done.returncode}: {done.stderr[-1500:]}"]
    return []


def _left(folder: Path) -> list[str]:
    """Commands of the processes that belong to a trial and do not end."""
    end = time.monotonic() + _PATIENCE
    while (left := _marked(f"{MARK}={folder}")) and time.monotonic() < end:
        time.sleep(0.05)
    for process in left:
        with contextlib.suppress(OSError):
            os.kill(process, signal.SIGKILL)
    return [*left.values()]


def _marked(mark: str) -> dict[int, str]:
    """Command lines of the processes whose environment has a mark, by their numbers."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        with contextlib.suppress(OSError):
            variables = (entry / "environ").read_bytes().split(b"\0")
            if os.fsencode(mark) in variables:
                words = (entry / "cmdline").read_bytes().split(b"\0")
                found[int(entry.name)] = b" ".join(words).decode("utf-8", "replace")[
                    :200
                ]
    return found


# What lies under its final name is whole


def _json(path: Path) -> None:
    json.loads(path.read_text("utf-8"))


_WHOLE: dict[str, Callable[[Path], object]] = {
    ".json": _json,
    ".ply": load_splat,
    ".spz": load_splat,
    ".png": load_picture,
    ".npy": load_array,
    ".xz": read_rows,
    ".safetensors": load_state,
}
"""What reads files by their endings."""


def half_written(folder: Path) -> list[str]:
    """Files that lie under their final names and are not whole, and results that are
    not what they list.
    """
    faults = []
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if any(map(is_temporary, parts)) or not path.is_file():
            continue
        if "tmp" in parts or "partial" in parts:  # of a store: what is being made
            continue
        faults += _broken(path)
        if path.name == MANIFEST:
            wrong = [
                check for check in check_files(path.parent) if check.passed is False
            ]
            faults += [
                f"{path.parent.name} is not what it lists: {check.name} {check.words}"
                for check in wrong
            ]
    return faults


def _broken(path: Path) -> list[str]:
    read = _WHOLE.get(path.suffix)
    if read is None or path.name == "points3D.ply":
        return []
    try:
        read(path)
    except (MiSplatError, ValueError) as error:
        return [f"{path.name} is not whole: {error}"]
    return []
