"""Runs the commands of the documentation: `python -m tests.project.run_documented
fast|nightly FOLDER [PAGE ...]`.

Each page has a folder of its own within FOLDER. What a line needs and no earlier line
of its page has made is made first, mostly by a command, too (`GIVEN`). Exit status 1,
and what failed on stderr, if a command fails.
"""

import contextlib
import gc
import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from attacks import cli
from attacks.detectors.registry import DETECTORS
from mi_splat import GaussianScene, load_splat, save_splat
from mi_splat.capture.objects import object_file
from mi_splat.maths.rotation import to_matrix
from mi_splat.processes import INTERRUPTED
from mi_splat.scene import Similarity, merge
from tests.project.documented_commands import (
    BENCHMARKS,
    NIGHTLY_PAGES,
    ROOT,
    Line,
    lines,
    shortened,
)
from tests.rewriting import rewrite_once
from tests.selection.bare import ground

SECONDS = 300
"""That a page in the browser, or a benchmark, may take."""


def car_on_ground() -> GaussianScene:
    """The shipped car without its parts, on a square of grey Gaussians."""
    car = load_splat(ROOT / "scenes" / "car_street_car.ply")
    return merge(car, ground(3000, half=4.0).with_degree(car.degree))


def splat(path: Path) -> None:
    """A bare splat whose z is up."""
    save_splat(car_on_ground(), path)


def splat_y_down(path: Path) -> None:
    """The same as COLMAP would have it, with y down."""
    quarter = to_matrix(
        torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0], dtype=torch.float64)
    )
    save_splat(
        car_on_ground().transform(
            Similarity(rotation=quarter, translation=torch.zeros(3))
        ),
        path,
    )


def mesh(path: Path) -> None:
    """An object that is shipped as a user's own."""
    shutil.copy(object_file("car"), path)


def shipped_artifact(path: Path) -> None:
    """An artifact of the documentation."""
    shutil.copytree(ROOT / path, path)


def small_study(path: Path) -> None:
    """One attack of a shipped study, looked at under one condition."""
    file = path.with_suffix(".toml")
    file.write_text("""study = "dagger"
question = "Does the attack succeed?"
scene = "scenes/car_street.xml"
object = "car"
target = "person"
renderer = "tile"
attack = { steps = 1, noise_draws = 0 }
[evaluate_with.matrix]
condition = ["tile"]
""")
    status = cli.main(["study", "run", str(file), "--out", str(path), "--workers", "0"])
    assert status == 0


PICTURES = (
    "mi-splat capture stop_sign --cameras hemisphere:4 --test 2 --format both --out"
    " {path}"
)
DAGGER = "mi-splat dagger scenes/car_street.xml --object car --out {path}"

GIVEN: dict[str, str | Callable[[Path], None]] = {
    "YOUR.ply": splat,
    "YOUR_SCENE.ply": splat_y_down,
    "RECEIVED.ply": splat_y_down,
    "web.splat": splat,
    "out/original.ply": splat,
    "YOUR.glb": mesh,
    **dict.fromkeys(("YOUR_SET", "out/set", "out/truck", "out/car-alone"), PICTURES),
    "out/desk": DAGGER,
    "out/desk/attacked.ply": (
        "mi-splat dagger YOUR.ply --mask out/mask.npy --azimuth 40 --elevation 25 --out"
        " out/desk"
    ),
    "out/mask.npy": "mi-splat select YOUR.ply --cluster 1 --out out/mask.npy",
    "out/elephant/attacked.ply": (
        "mi-splat dagger scenes/car_street.xml --object car --out out/elephant"
    ),
    "out/attacked.spz": "mi-splat convert scenes/car_street_car.ply out/attacked.spz",
    "out/person": DAGGER,
    "out/cloak": "mi-splat cloak scenes/cloak_car_colour.toml --out {path}",
    "out/layers": "mi-splat cloak scenes/cloak_car_layers.toml --out {path}",
    "docs/artifacts/cloak_car_layers": shipped_artifact,
    "docs/artifacts/cloak_car_stealthy": shipped_artifact,
    "out/studies/between_renderers": small_study,
}
"""What pages take as given: a command that makes it, or a function."""


def small_scenes(folder: Path) -> None:
    """The scenes, with studies of CLOAK that are done in a minute or two."""
    shutil.copytree(ROOT / "scenes", folder)
    fewer: dict[str, float] = {
        "train": 56,
        "size": 64,
        "samples": 2,
        "points": 1500,
        "iterations": 150,
        "max_gaussians": 2500,
    }
    fewer |= {
        "outliers": 200,
        "cameras": 40,
        "reference_views": 4,
        "meridians": 1,
        "meridian_step": 15.0,
    }
    for path in folder.glob("cloak_*.toml"):
        text = path.read_text()
        if "\npoints = " not in text:
            text = text.replace("[cameras]\n", "[cameras]\npoints = 1500\n")
        for key, value in fewer.items():
            # which need room for as many Gaussians as they make
            head, layers, rest = text.partition("\n[layers]")
            parts = [head, layers, rest] if key == "max_gaussians" else [text]
            parts[0] = re.sub(
                rf"^{key} = [\d.]+", f"{key} = {value}", parts[0], flags=re.MULTILINE
            )
            text = "".join(parts)
        text = re.sub(r"^seeds = \[.*?\]", "seeds = [0]", text, flags=re.MULTILINE)
        path.write_text(
            re.sub(
                r"^detectors = .*$",
                'detectors = ["fasterrcnn_small"]',
                text,
                flags=re.MULTILINE,
            )
        )
    for path in (folder / "studies").glob("*.toml"):
        path.write_text(shortened_study(path.read_text(), SMALL_ATTACKS.get(path.stem)))


SMALL_ATTACKS = {
    "pairs": "{ steps = 1, noise_draws = 1 }",
    "eot_pairs": "{ steps = 1, batch = 1, pool = 1, validation = 1, held_out = 1 }",
}
"""What attacks are in small copies of studies, by their names."""


def shortened_study(text: str, attack: str | None) -> str:
    """A study with one value of each axis, and the first case of its attacks with other
    settings; None leaves both.
    """
    text = re.sub(
        r"(^    \{ name = .*\n)(?:    \{ name = .*\n)+", r"\1", text, flags=re.MULTILINE
    )
    text = re.sub(r'^("[a-z_.]+" = \[[^\[{,]+),.*\]$', r"\1]", text, flags=re.MULTILINE)
    if attack is None:
        return text
    text = "[[case]]".join(text.split("[[case]]")[:2])
    return re.sub(r"^attack = \{.*\}$", f"attack = {attack}", text, flags=re.MULTILINE)


def provide(line: Line, kept: dict[str, Path]) -> None:
    """Make what a line reads, is not there, and can be made; what another page was
    given is copied.

    `kept` has a copy of what each entry of `GIVEN` that is a command has made; more are
    added.
    """
    outputs = {"--out", "--export"}
    reads = True
    for number, word in enumerate(line.words):
        if line.kind == "convert" and number == 3:
            continue  # the file to write
        if word.startswith("--"):
            reads = word not in outputs
        elif reads and word in GIVEN and not Path(word).exists():
            Path(word).parent.mkdir(parents=True, exist_ok=True)
            make = GIVEN[word]
            if isinstance(make, str):
                given = Line("GIVEN", tuple(shlex.split(make.format(path=word))))
                if make not in kept:
                    provide(given, kept)
                    execute(given)
                    kept[make] = _copied(
                        Path(given.words[-1]), kept["folder"] / str(len(kept))
                    )
                else:
                    _copied(kept[make], Path(given.words[-1]))
            else:
                make(Path(word))


def _copied(made: Path, target: Path) -> Path:
    """Copy a file or a folder to a place, which is returned."""
    if made.is_dir():
        shutil.copytree(made, target, dirs_exist_ok=True)
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(made, target)
    return target


class CommandError(Exception):
    """A command of the documentation failed; the message is what it said."""


def execute(line: Line) -> None:
    """Run a line in the current folder."""
    if line.program == "make":
        for recipe in re.findall(
            rf"^{line.words[1]}:.*\n((?:\t.*\n)*)",
            (ROOT / "Makefile").read_text(),
            re.MULTILINE,
        ):
            for command in re.findall(r"\$\(BIN\)/(mi-splat .*)", recipe):
                execute(
                    Line(
                        line.page,
                        tuple(shlex.split(command.replace("$(OUT)", "out/demo"))),
                    )
                )
        return
    if line.program == "python":
        added = BENCHMARKS[line.words[1]]
        _wait([sys.executable, *line.words[1:], *added], ROOT)
        return
    words = shortened(line)
    if line.kind == "view":
        _wait(
            [sys.executable, "-m", "attacks", *words, "--port", "0"],
            Path(),
            until="http://",
        )
        return
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = cli.main(words)
    if status != 0:
        raise CommandError(
            f"{shlex.join(words)}: exit status {status}\n{printed.getvalue()[-600:]}"
        )


def _wait(command: Sequence[str], folder: Path, until: str | None = None) -> None:
    """Run a program to its end; once it has said `until`, it is interrupted as a user
    would do it.
    """
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    alarm = threading.Timer(SECONDS, process.kill)
    alarm.start()
    printed = ""
    assert process.stdout is not None
    for text in process.stdout:
        printed += text
        if until is not None and until in text:
            time.sleep(1)
            process.send_signal(signal.SIGINT)
            until = None
    status = process.wait()
    alarm.cancel()
    if status not in (0, INTERRUPTED) or until is not None:
        raise CommandError(
            f"{shlex.join(command)}: exit status {status}\n{printed[-600:]}"
        )


def chosen(when: str) -> dict[str, list[Line]]:
    """The lines to run by page: all fast ones, or all of each page that has a nightly
    one.
    """
    lines_by_page: dict[str, list[Line]] = {}
    for line in lines():
        lines_by_page.setdefault(line.page, []).append(line)
    if when == "fast":
        return {
            page: [line for line in every if line.when == "fast"]
            for page, every in lines_by_page.items()
        }
    nightly = {
        page
        for page, every in lines_by_page.items()
        if any(line.when == "nightly" for line in every)
    }
    runnable = {
        page: [line for line in lines_by_page[page] if line.when != "never"]
        for page in nightly | NIGHTLY_PAGES
    }
    return dict(sorted(runnable.items()))


def not_here(words: Sequence[str]) -> list[str]:
    """Detectors that a line names and that others trained, whose weights a new machine
    does not have.
    """
    named = [
        word for word in words if word in DETECTORS.own and "--weights" not in words
    ]
    return [name for name in named if DETECTORS[name].missing()]


def main(when: str, folder: Path, only: Sequence[str] = ()) -> int:
    """Run the lines, and report each that fails and how long each took."""
    # a shell has what it runs in the background ignore Ctrl-C, which `view` waits for
    signal.signal(signal.SIGINT, signal.default_int_handler)
    failed = 0
    kept = {"folder": folder / "given"}
    rewrite_once()
    small_scenes(folder / "scenes")
    for page, every in chosen(when).items():
        if not every or (only and page not in only):
            continue
        here = folder / page.replace("/", "_")
        here.mkdir()
        (here / "scenes").symlink_to(folder / "scenes")
        os.chdir(here)
        # so that a command that collects garbage does not look through all that others
        # have imported
        gc.freeze()
        for line in every:
            missing = not_here(shortened(line))
            if missing:
                sys.stdout.write(
                    f"   left out  {line}: {', '.join(missing)} is not here\n"
                )
                continue
            begun = time.monotonic()
            try:
                provide(line, kept)
                execute(line)
            except CommandError as error:
                failed += 1
                sys.stderr.write(f"{line}\n  ran as {error}\n")
            sys.stdout.write(f"{time.monotonic() - begun:6.1f} s  {line}\n")
            sys.stdout.flush()
    if failed:
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2]).resolve(), sys.argv[3:]))
