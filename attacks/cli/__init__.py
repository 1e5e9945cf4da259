"""The command line: `mi-splat COMMAND ...`, also `python -m attacks COMMAND ...`.

Only the standard library is imported here, so that `--help` answers at once. A command's options are parsed (by
`attacks.cli.parsing`, from a dataclass in `options` beside it) before its module, and with it torch and Mitsuba, is
imported.
"""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from mi_splat.cli.console import PROGRAM, UsageError, progress, warn
from mi_splat.errors import MiSplatError, message, nearest, printable

DONE, FAILED, MISUSED, INTERRUPTED = 0, 1, 2, 130


class Command(NamedTuple):
    """A subcommand.

    Attributes:
        package: Where its module is, and beside it the one of its options.
        options: Name of that dataclass.
        module: Name of the module, whose `run(options)` does the work.
        summary: One line of help.
        defaults: Name of a function beside the options that reads from the words what other flags depend on; empty for
            none.
        options_module: Name of the module that has the options.
    """

    package: str
    options: str
    module: str
    summary: str
    defaults: str = ""
    options_module: str = "options"


COMMANDS = {
    "capture": Command(
        "mi_splat.cli", "CaptureOptions", "capture", "take pictures of a mesh scene, to train a splat from"
    ),
    "train": Command(
        "mi_splat.cli", "TrainOptions", "train", "train a splat on pictures with cameras", defaults="train_defaults"
    ),
    "render": Command("mi_splat.cli", "RenderOptions", "render", "render a splat: a picture, many, or an animation"),
    "compare": Command(
        "attacks.cli",
        "CompareOptions",
        "compare",
        "compare renderers on one splat: pictures, gradients, time and memory",
        options_module="compare_options",
    ),
    "select": Command(
        "mi_splat.cli", "SelectOptions", "select", "select one object of a splat, and see whether it is the right one"
    ),
    "info": Command("mi_splat.cli", "InfoOptions", "info", "what a splat file or a scene XML holds"),
    "convert": Command("mi_splat.cli", "ConvertOptions", "convert", "convert a splat file to another format"),
    "example-scenes": Command(
        "mi_splat.cli", "ExampleScenesOptions", "example_scenes", "make one of the shipped splat scenes again"
    ),
    "dagger": Command(
        "attacks.cli", "DaggerOptions", "dagger", "attack one object of a splat scene, so that a detector misreads it"
    ),
    "dagger-eot": Command(
        "attacks.cli",
        "DaggerEotOptions",
        "dagger_eot",
        "the same attack for all cameras of a region at once, judged on held-out views",
        options_module="eot_options",
    ),
    "detect": Command("attacks.cli", "DetectOptions", "detect", "what detectors see in pictures, splats and scenes"),
    "evaluate": Command(
        "attacks.cli",
        "EvaluateOptions",
        "evaluate",
        "how often an object is found, missed or misread, clean and attacked",
    ),
    "study": Command(
        "attacks.cli",
        "StudyOptions",
        "study",
        "many attacks and what they hang on, from one TOML file: plan, run, status",
        options_module="study",
    ),
    "dagger-sanity": Command(
        "attacks.cli",
        "DaggerSanityOptions",
        "dagger_sanity",
        "whether DAGGER is a sane attack on an object and a detector, line by line",
        options_module="sanity_options",
    ),
    "cloak": Command(
        "attacks.cli",
        "CloakOptions",
        "cloak",
        "poison training pictures, train on them, and measure who sees what (CLOAK)",
    ),
    "cloak-experiment": Command(
        "attacks.cli",
        "CloakExperimentOptions",
        "cloak_experiment",
        "explain a figure of a CLOAK study",
        options_module="experiment_options",
    ),
    "artifact": Command(
        "attacks.cli",
        "ArtifactOptions",
        "artifact",
        "pack a finished result with its raw rows, so that others can check its figures",
        options_module="artifact_options",
    ),
    "artifact-check": Command(
        "attacks.cli",
        "ArtifactCheckOptions",
        "artifact_check",
        "derive every figure of artifacts again from their rows, or score their splats again",
        options_module="artifact_options",
    ),
    "view": Command(
        "attacks.cli", "ViewOptions", "view", "look at a splat or a result in the browser, clean beside attacked"
    ),
    "report": Command(
        "attacks.cli",
        "ReportOptions",
        "report",
        "one page of results: figures with intervals and controls, warnings, how to repeat them",
        options_module="report_options",
    ),
    "rows": Command(
        "attacks.cli",
        "RowsOptions",
        "rows",
        "the rows of a result, from which its figures are counted: as CSV or JSON",
        options_module="rows",
    ),
    "detectors": Command(
        "attacks.cli",
        "DetectorsOptions",
        "detectors",
        "the detectors, their classes, and whether the weights are there; get some of others",
        options_module="detectors",
    ),
    "train-detector": Command(
        "attacks.cli",
        "TrainDetectorOptions",
        "train_detector",
        "train one of the project's small detectors",
        options_module="train_detector",
    ),
    "evaluate-detector": Command(
        "attacks.cli",
        "EvaluateDetectorOptions",
        "evaluate_detector",
        "mAP, recall and false positives of a detector on held-out pictures",
        options_module="evaluate_detector",
    ),
    "compare-detectors": Command(
        "attacks.cli",
        "CompareDetectorsOptions",
        "compare_detectors",
        "the figures of several detectors side by side",
        options_module="compare_detectors",
    ),
    "plot-detector-training": Command(
        "attacks.cli",
        "PlotDetectorTrainingOptions",
        "plot_detector_training",
        "draw losses and validation mAP of a detector's training",
        options_module="plot_detector_training",
    ),
    "doctor": Command(
        "attacks.cli",
        "DoctorOptions",
        "doctor",
        "check that everything works here, and say what to do where it does not",
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the process's exit status.

    Args:
        arguments: What follows the program's name; taken from `sys.argv` if None.

    Returns:
        0 done, 1 an error (its one line is on stderr), 2 wrong usage, 130 interrupted.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _plain_warnings():
            return _dispatch(words)
    except SystemExit as stop:  # argparse ends --help this way
        return stop.code if isinstance(stop.code, int) else DONE if stop.code is None else FAILED
    except KeyboardInterrupt:
        warn("interrupted")
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output, `head` for instance, has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except UsageError as error:
        name = words[0] if words and words[0] in COMMANDS else ""
        warn(f"{f'{name}: ' if name else ''}{error} (see {PROGRAM} {f'{name} ' if name else ''}--help)")
        return MISUSED
    except (MiSplatError, OSError) as error:
        hint = error.hint if isinstance(error, MiSplatError) else ""
        warn(" ".join(f"{error} ({hint})".split() if hint else str(error).split()))
        return FAILED


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Show warnings in one line each, without the line of code that raised them."""
    before = warnings.formatwarning
    warnings.formatwarning = lambda text, *_, **__: f"{PROGRAM}: warning: {printable(' '.join(str(text).split()))}\n"
    try:
        yield
    finally:
        warnings.formatwarning = before


def _dispatch(words: list[str]) -> int:
    """Answer --help and --version, or find the command and hand its options to it."""
    given = [PROGRAM, *words]
    most = _take_max_pixels(words)
    if words[:1] == ["help"] and len(words) > 1:
        words = [words[1], "--help"]
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(_help())
        return DONE if words else MISUSED
    if words[0] == "--version":
        from importlib.metadata import version

        sys.stdout.write(f"{PROGRAM} {version('mi-splat')}\n")
        return DONE
    name, *rest = words
    if name not in COMMANDS:
        warn(
            message("command", f"one of {', '.join(COMMANDS)}", name, nearest(name, COMMANDS, f"try {PROGRAM} --help"))
        )
        return MISUSED
    from attacks.cli.names import check_names
    from attacks.cli.parsing import parse

    options = parse(name, COMMANDS[name], rest)
    check_names(options)
    with progress("starting"):
        module = importlib.import_module(f"{COMMANDS[name].package}.{COMMANDS[name].module}")
    from mi_splat.provenance import running_command

    with running_command(given):
        if most is None:
            return int(module.run(options))
        from mi_splat.io.picture_files import pixel_limit

        with pixel_limit(most):
            return int(module.run(options))


def _take_max_pixels(words: list[str]) -> int | None:
    """The number behind --max-pixels, which every command takes; None if it is not there.

    Args:
        words: What the user typed; the flag and its number are removed.

    Raises:
        UsageError: It is no number of pixels.
    """
    found = None
    for word in [word for word in words if word.partition("=")[0] in ("--max-pixels", "--max_pixels")]:
        place = words.index(word)
        values = [word.partition("=")[2]] if "=" in word else words[place + 1 : place + 2]
        del words[place : place + (1 if "=" in word else 2)]
        if not values or not values[0].isdecimal() or len(values[0]) > 18 or int(values[0]) < 1:
            got = values[0][:40] if values else "nothing"
            raise UsageError(f"--max-pixels: expected a number of pixels, 1 or more, got {got}; 50000000 is usual")
        found = int(values[0])
    return found


def _help() -> str:
    """The text of `mi-splat --help`."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            f"usage: {PROGRAM} COMMAND [OPTIONS]",
            "",
            "Attacks on 3D Gaussian splats, rendered by Mitsuba.",
            "",
            "commands:",
            *lines,
            "",
            f"  {PROGRAM} help COMMAND  the options of one command; also {PROGRAM} COMMAND --help",
            f"  {PROGRAM} --version     the version",
            "  --max-pixels N         with any command: pixels that a picture which is read may have (50000000)",
            "",
            "exit status: 0 done (also when an attack fails: that is a result), 1 error, 2 wrong usage",
            "",
        ]
    )
