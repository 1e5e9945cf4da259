"""The command line: `mi-splat COMMAND ...`, also `python -m attacks COMMAND ...`.

A command is a module with its options, a dataclass, its EXAMPLES, and `run(options)`.
It, or the options of one of its commands, may have `defaults(words)`, which reads what
other flags depend on, and the module `check_inputs(options)`, which is called before
torch and Mitsuba are imported. Commands that share most of their code share a module.
"""

from __future__ import annotations

import importlib
import inspect
import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import ModuleType
from typing import TYPE_CHECKING, Any

from mi_splat.cli.console import PROGRAM, UsageError, import_at_once, show_notes, warn
from mi_splat.errors import (
    MiSplatError,
    message,
    nearest,
    one_line,
    printable,
    shortened,
)
from mi_splat.processes import INTERRUPTED, TERMINATED, sigterm_as_interrupt

if TYPE_CHECKING:
    import argparse

DONE = 0
FAILED = 1
MISUSED = 2


GROUPS: dict[str, dict[str, str]] = {
    "look at a splat": {
        "info": "what a splat, a scene XML or a set of photographs contains",
        "view": (
            "interactive viewer: a splat or a result in the browser, clean beside"
            " attacked"
        ),
        "render": "render images or an animation of a splat",
        "compare": "compare renderers on one splat: images, gradients and time",
        "conform": (
            "test a renderer or a converter against the definition of 3D Gaussian"
            " Splatting"
        ),
        "convert": "convert a splat file to another format",
        "select": "select one object of a splat, and check the selection",
    },
    "make a splat": {
        "prepare": (
            "find the cameras of photographs or of a video, for a set to train on"
        ),
        "capture": "render training images of a mesh scene",
        "train": "train a splat on images with cameras",
    },
    "attack": {
        "demo": "run DAGGER on the car of the example scene, in about 20 seconds",
        "dagger": (
            "perturb one object of a splat so that a detector misreads it (DAGGER)"
        ),
        "dagger --region": (
            "the same for all cameras of a region (EOT), evaluated on held-out views"
        ),
        "cloak": (
            "poison training images, train on them, and measure what detectors report"
            " (CLOAK)"
        ),
        "poison": (
            "poison the images of a training set: CLOAK, Poison-splat, M-IFGSM and"
            " controls"
        ),
    },
    "audit and measure": {
        "audit": (
            "check a splat for hidden, view-dependent appearances, edits and invalid"
            " data, or a set of images for poisoned ones"
        ),
        "bound": (
            "a copy of a splat whose colours hardly depend on the direction, with a"
            " certificate"
        ),
        "gate": (
            "accept, quarantine or refuse many splat files, for uploads and pipelines"
        ),
        "detect": "what detectors report on images, splats and scenes",
        "evaluate": (
            "detection rates and attack success rates of a result, clean and attacked"
        ),
        "study": "many attacks from one TOML file: plan, run, resume, status",
        "bench": (
            "robustness benchmark: one suite of attacks, the same for every detector"
        ),
        "report": (
            "one HTML page of results: rates with intervals, controls, warnings, how to"
            " repeat them"
        ),
        "rows": "the raw rows of a result as CSV or JSON",
        "artifact": (
            "pack a result with its raw rows, so that others can check its figures"
        ),
        "artifact-check": "derive every figure of an artifact again from its rows",
    },
    "set up": {
        "doctor": "check the installation, and say how to fix it",
        "detectors": "list the detectors and classifiers; download third-party ones",
    },
}
"""What each command does, by task; a name with a flag is a mode of a command, with
options of its own.
"""
COMMANDS = {
    name: summary for group in GROUPS.values() for name, summary in group.items()
}
OF_SPLATS = (
    "prepare",
    "capture",
    "train",
    "render",
    "info",
    "bound",
    "conform",
    "convert",
)
"""Commands whose modules are in `mi_splat.cli`; those of the others are here."""
WITHOUT_TORCH = ("conform", "detectors", "doctor", "gate", "info", "rows", "study")
"""Commands that do without torch, or with most of what they are asked."""


OTHER_MODULES = {
    **dict.fromkeys(("dagger --region", "demo"), "dagger"),
    "artifact-check": "artifact",
    "rows": "report",
}
"""Commands in the module of another one, by its name; `run_region` does what
`dagger --region` is to do.
"""


def module_of(name: str) -> ModuleType:
    """The module of a command or of its mode."""
    package = "mi_splat" if name in OF_SPLATS else "attacks"
    return importlib.import_module(f"{package}.cli.{OTHER_MODULES.get(name, name)}")


def examples_of(name: str) -> list[str]:
    """Lines that show how a command is used."""
    return [
        line for line in module_of(name).EXAMPLES if command_of(line.split())[0] == name
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the process's exit status."""
    with sigterm_as_interrupt() as signal_status:
        try:
            status = _written(_answered(arguments))
        except KeyboardInterrupt:
            status = signal_status() or INTERRUPTED
        except Exception:
            if signal_status() is None:
                raise
            status = FAILED
    # What a signal breaks off may fail in other words: the signal is the reason.
    if status == FAILED:
        status = signal_status() or FAILED
    if status in _ENDED:
        warn(_ENDED[status])
    return status


_ENDED = {INTERRUPTED: "interrupted", TERMINATED: "terminated"}


def _written(status: int) -> int:
    """The exit status of a command whose output may not have reached what it was
    written to.
    """
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _discard_output()
    except (OSError, ValueError) as error:
        got = getattr(error, "strerror", None) or str(error)
        expected = "a place that can be written"
        do = "free some space, or write to another place"
        warn(message("standard output", expected, got, do))
        return status or FAILED
    return status


def _discard_output() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _answered(arguments: Sequence[str] | None) -> int:
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _plain_warnings():
            return _dispatch(words)
    except SystemExit as stop:  # argparse ends --help this way
        if isinstance(stop.code, int):
            return stop.code
        if stop.code is None:
            return DONE
        return FAILED
    except BrokenPipeError:  # the reader of our output, `head` for instance, has gone
        _discard_output()
        return DONE
    except UsageError as error:
        name = command_of(words)[0] if words and words[0] in COMMANDS else ""
        warn(
            f"{f'{name}: ' if name else ''}{error} (see {PROGRAM}"
            f" {f'{name} ' if name else ''}--help)"
        )
        return MISUSED
    except (MiSplatError, OSError) as error:
        if isinstance(error, OSError):
            error = _in_our_words(error)
        hint = f" ({error.hint})" if error.hint else ""
        warn(shortened(" ".join(f"{error}{hint}".split()), _LONGEST))
        return FAILED
    except (MemoryError, ImportError) as error:
        text = _in_short_of_memory(error)
        if not text:
            raise
        warn(text)
        return FAILED


def _in_our_words(error: OSError) -> MiSplatError:
    """An error of the system as one of ours, which says what to do."""
    from mi_splat.io.errors import from_os_error

    if isinstance(error, MiSplatError):
        return error
    if isinstance(error.filename, str | bytes):
        where = os.fsdecode(error.filename)
    else:
        where = "files"
    return from_os_error(where, "files that can be read and written", error)


_LONGEST = 4000
"""Signs of an error message; one that lists all names of a kind is long."""


def _in_short_of_memory(error: MemoryError | ImportError) -> str:
    """The message for an error that a lack of memory led to; empty for another one."""
    words = one_line(str(error), 200)
    if isinstance(error, ImportError) and not any(sign in words for sign in _NO_MEMORY):
        return ""
    do = "give it more (`ulimit -v`), or take a smaller input"
    return message(
        "memory", "enough memory for this command", words or "too little", do
    )


_NO_MEMORY = ("failed to map segment", "annot allocate memory", "failed to allocate")
"""What the loader of libraries says where there is too little memory for one."""


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Show warnings in one line each, once, without the line of code that raised
    them.
    """
    before = warnings.formatwarning
    shown = set[str]()

    def formatted(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        line: str | None = None,
    ) -> str:
        words = printable(" ".join(str(message).split()))
        if words in shown:
            return ""
        shown.add(words)
        return f"{PROGRAM}: warning: {words}\n"

    warnings.formatwarning = formatted
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
        if words:
            return DONE
        return MISUSED
    if words[0] == "--version":
        sys.stdout.write(_versions())
        return DONE
    if words[0] == "--completion":
        return _completion(words[1:])
    name, rest = command_of(words)
    if name not in COMMANDS:
        do = nearest(name, COMMANDS, f"try {PROGRAM} --help")
        warn(
            message(
                "command",
                f"one of {', '.join(name for name in COMMANDS if ' ' not in name)}",
                name,
                do,
            )
        )
        return MISUSED
    from attacks.cli.options import check_names
    from mi_splat.provenance import running_command

    options = parse(name, rest)
    check_names(options)
    module = module_of(name)
    run = getattr(
        module, f"run_{name.split('-')[-1]}" if name in OTHER_MODULES else "run"
    )
    if hasattr(module, "check_inputs") and name not in OTHER_MODULES:
        module.check_inputs(options)
    if name not in WITHOUT_TORCH:
        import_at_once("torch")
    succeeded = False
    try:
        with running_command(given), _pixel_limit(most):
            status = run(options) or DONE
        succeeded = True
    finally:
        show_notes(succeeded=succeeded)
    return int(status)


def _pixel_limit(most: int | None) -> AbstractContextManager[object]:
    if most is None:
        return nullcontext()
    from mi_splat.io.picture_files import pixel_limit

    return pixel_limit(most)


def command_of(words: Sequence[str]) -> tuple[str, list[str]]:
    """The command that the first word names, or its mode that a flag chooses, and the
    other words.
    """
    name, *rest = words
    for word in rest:
        if f"{name} {word}" in COMMANDS:
            return f"{name} {word}", [other for other in rest if other != word]
    return name, rest


def parse(name: str, words: Sequence[str]) -> Any:
    """The options of a command from the words that the user typed; ends the process for
    --help.
    """
    from mi_splat.cli import flags

    return flags.parse(**_command(name, words), words=words)


def parser_of(name: str) -> argparse.ArgumentParser:
    """The options of a command as a parser, from which documentation can be written."""
    from mi_splat.cli import flags

    return flags.parser_of(**_command(name, ()))


def see_also(name: str) -> list[str]:
    """The other commands for the task of a command."""
    return [
        other
        for group in GROUPS.values()
        if name in group
        for other in group
        if other != name
    ]


def _command(name: str, words: Sequence[str]) -> dict[str, Any]:
    """What a parser has to know of a command: its options, and its help."""
    module = module_of(name)
    kind = getattr(
        module,
        "".join(word.capitalize() for word in re.findall(r"\w+", name)) + "Options",
    )
    parts = [
        inspect.getdoc(kind) or "",
        "\n".join(
            ["Examples:", *(f"  {PROGRAM} {line}" for line in examples_of(name))]
        ),
        f"See also: {', '.join(see_also(name))}",
    ]
    source = kind if hasattr(kind, "defaults") else module
    defaults = source.defaults(words) if hasattr(source, "defaults") else {}
    description = "\n\n".join(parts)
    return {
        "kind": kind,
        "program": f"{PROGRAM} {name}",
        "description": description,
        "defaults": defaults,
    }


def _take_max_pixels(words: list[str]) -> int | None:
    """The number behind --max-pixels, which every command takes; it leaves the words.

    None if it is not there.
    """
    most = None
    for word in [
        word
        for word in words
        if word.partition("=")[0] in ("--max-pixels", "--max_pixels")
    ]:
        index, (_, equals, number) = words.index(word), word.partition("=")
        number = number if equals else "".join(words[index + 1 : index + 2])
        del words[index : index + (1 if equals else 2)]
        if not number.isdecimal() or not 1 <= int(number[:19]) < 10**18:
            got = number[:40] or "nothing"
            raise UsageError(
                f"--max-pixels: expected a number of pixels, 1 or more, got {got};"
                " 50000000 is usual"
            )
        most = int(number)
    return most


def _versions() -> str:
    from mi_splat.provenance import commit, versions

    packages = versions()
    version = packages.pop("mi-splat")
    where = commit()
    beneath = ", ".join(f"{name} {number}" for name, number in packages.items())
    return f"{PROGRAM} {version}{f' ({where})' if where else ''}\n{beneath}\n"


def _completion(words: Sequence[str]) -> int:
    import argparse

    import shtab

    shell = words[0] if len(words) == 1 else ""
    if shell not in shtab.SUPPORTED_SHELLS:
        raise UsageError.of(
            "--completion",
            "bash, zsh or tcsh",
            " ".join(words) or "nothing",
            "name one shell",
        )
    whole = argparse.ArgumentParser(PROGRAM)
    commands = whole.add_subparsers()
    for name, summary in COMMANDS.items():
        if " " not in name:
            commands.add_parser(
                name, parents=[parser_of(name)], help=summary, add_help=False
            )
    sys.stdout.write(shtab.complete(whole, shell))
    return DONE


def _help() -> str:
    width = max(map(len, COMMANDS))
    commands = "\n\n".join(
        "\n".join(
            [
                f"{task}:",
                *(f"  {name:{width}}  {summary}" for name, summary in group.items()),
            ]
        )
        for task, group in GROUPS.items()
    )
    return f"""\
usage: {PROGRAM} COMMAND [OPTIONS]

Adversarial attacks on, and forensic audits of, 3D Gaussian splats.

{commands}

  {PROGRAM} help COMMAND  the options of one command; also {PROGRAM} COMMAND --help
  {PROGRAM} --version     the version, the commit of a checkout, and the versions of
                         the packages beneath
  {PROGRAM} --completion bash|zsh|tcsh  a script that completes commands and options
                         in your shell
  --max-pixels N         with any command: the largest image that is read, in pixels
                         (50000000)

exit status: 0 done (also when an attack fails: that is a result), 1 error,
  2 wrong usage; audit: 3 found; 130 Ctrl-C, 143 SIGTERM: what can be resumed is kept
"""
