"""Processes that have torch imported already: a test starts a program without waiting
for that.

One process imports torch and torchvision, which takes seconds of every program here,
and nothing else that is not in the standard library. For each program it forks: what
the program imports, writes or breaks stays in its own process.
"""

import atexit
import contextlib
import gc
import json
import os
import runpy
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NoReturn

FORKS = sys.platform == "linux"
"""Elsewhere each program gets a process that imports everything itself."""


class Warm:
    """Runs programs as `python -c CODE ...` or `python -m MODULE ...` would.

    Its process begins with the first program and ends with `close`.
    """

    def __init__(self) -> None:
        self._server: subprocess.Popen[str] | None = None

    def run(
        self,
        *words: str,
        cwd: Path,
        missing: Sequence[str] = (),
        check: bool = False,
        kill: tuple[float, int] | None = None,
        mark: tuple[str, str] | None = None,
    ) -> subprocess.CompletedProcess[str]:
        """Run a program to its end.

        Args:
            words: `-m` or `-c`, and what follows.
            cwd: Its working folder.
            missing: Modules that it does not find.
            check: Whether another status than 0 is an error.
            kill: After how many seconds it gets which signal, unless it has ended; None
                for no signal.
            mark: A variable of its environment, and of that of all that it starts, with
                its value.
        """
        if self._server is None:
            command = [sys.executable, "-m", "tests.warm"]
            root = Path(__file__).resolve().parents[1]
            self._server = subprocess.Popen(
                command,
                cwd=root,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        server = self._server
        assert server.stdin is not None
        assert server.stdout is not None
        with TemporaryDirectory() as folder:
            request: dict[str, Any] = {
                "words": words,
                "cwd": str(cwd),
                "missing": list(missing),
                "folder": folder,
            }
            request |= {"kill": kill, "mark": mark}
            server.stdin.write(json.dumps(request) + "\n")
            server.stdin.flush()
            status = int(server.stdout.readline())
            output, told = (
                Path(folder, name).read_text() for name in ("stdout", "stderr")
            )
        if not FORKS:
            self.close()
        done = subprocess.CompletedProcess(
            [sys.executable, *words], status, output, told
        )
        if check:
            done.check_returncode()
        return done

    def close(self) -> None:
        """End the process that forks."""
        if self._server is not None:
            assert self._server.stdin is not None
            assert self._server.stdout is not None
            self._server.stdin.close()
            self._server.wait()
            self._server.stdout.close()
            self._server = None


def serve() -> None:
    """Fork for each request on stdin, and say its exit status on stdout."""
    from attacks.cli.doctor import EXTRAS

    if FORKS:
        modules = [module for several in EXTRAS.values() for module in several]
        # None: not to be imported
        sys.modules.update(dict.fromkeys(modules))  # type: ignore[arg-type]
        import torch
        import torchvision  # noqa: F401

        torch.set_num_threads(1)
        ours = [
            name
            for name in sys.modules
            if name.split(".")[0] in ("attacks", "mi_splat")
        ]
        for module in (*modules, *ours):
            del sys.modules[module]
        assert threading.active_count() == 1
        gc.freeze()
    for text in sys.stdin:
        request = json.loads(text)
        child = os.fork()
        if child == 0:
            _end(_status(request))
        status = _ended(child, request["kill"])
        sys.stdout.write(f"{os.waitstatus_to_exitcode(status)}\n")
        sys.stdout.flush()
    _end(0)


def _ended(child: int, kill: tuple[float, int] | None) -> int:
    """Wait for a child, which gets a signal meanwhile if there is one; its status."""
    if kill is not None:
        seconds, number = kill
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if (
                os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT)
                is not None
            ):
                break
            time.sleep(0.002)
        # it is not waited for yet, so that its number is still its own
        os.kill(child, number)
    return os.waitpid(child, 0)[1]


def _end(status: int) -> NoReturn:
    """End this process as Python does, but do not take torch apart before, which takes
    a second.
    """
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(BrokenPipeError):
            stream.flush()
    os._exit(status)


def _status(request: dict[str, Any]) -> int:
    """Become the program of a request; its exit status."""
    try:
        _begin(request)
    except SystemExit as stop:
        if isinstance(stop.code, str):
            sys.stderr.write(f"{stop.code}\n")
        if isinstance(stop.code, int):
            return stop.code
        if stop.code is None:
            return 0
        return 1
    except BaseException:  # noqa: BLE001  # as Python does at the end of a program
        traceback.print_exc()
        return 1
    return 0


def _begin(request: dict[str, Any]) -> None:
    """Become the program of a request."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        path = os.devnull if number == 0 else os.path.join(request["folder"], name)
        os.dup2(
            os.open(path, os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT),
            number,
        )
    os.chdir(request["cwd"])
    if request["mark"]:
        os.environ.update([request["mark"]])
    missing = request["missing"]
    if missing:
        _hide(missing)
    kind, program, *others = request["words"]
    sys.argv, sys.path[0] = [kind, *others], ""
    if kind == "-m":
        runpy.run_module(program, run_name="__main__", alter_sys=True)
    else:
        assert kind == "-c"
        module = type(sys)("__main__")
        sys.modules["__main__"] = module
        exec(compile(program, "<string>", "exec"), vars(module))


def _hide(missing: list[str]) -> None:
    """Let modules be neither imported nor found among what is installed."""
    from importlib.metadata import Distribution, PackageNotFoundError

    original = Distribution.from_name

    def from_name(name: str) -> Distribution:
        if name in missing:
            raise PackageNotFoundError(name)
        return original(name)

    Distribution.from_name = from_name  # type: ignore[method-assign]
    assert not set(missing) & set(sys.modules), (
        "a module that is to be missing is there already"
    )
    # None: not to be imported
    sys.modules.update(dict.fromkeys(missing))  # type: ignore[arg-type]


if __name__ == "__main__":
    serve()
