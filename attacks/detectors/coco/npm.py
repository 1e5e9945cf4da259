"""Packages of npm, got by the user's own npm."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from attacks.detectors.errors import DetectorError
from mi_splat.errors import message

LONGEST = 1800.0
"""Seconds after which npm is stopped: enough for 150 MB at 100 kB a second."""
_SHOWN = 300
_SETTINGS = (
    "--ignore-scripts",
    "--loglevel=error",
    "--no-progress",
    "--fetch-retries=1",
    "--fetch-retry-mintimeout=2000",
)
_NO_NETWORK = (
    *("ENOTFOUND", "EAI_AGAIN", "ECONNREFUSED", "ECONNRESET", "ETIMEDOUT", "ENETUNREACH", "EHOSTUNREACH"),
    "ERR_SOCKET_TIMEOUT",
)
_NO_PACKAGE = ("E404", "ETARGET", "ENOVERSIONS")
"""What npm says where there is no network, and where its registry lacks the package or the version."""


def pack(spec: str, folder: Path, *, on_wait: Callable[[], None] = lambda: None) -> Path:
    """The .tgz file of a package, which `npm pack` gets into a folder; no code of the package is run.

    Args:
        spec: Name and version, `name@1.2.3`.
        folder: An empty folder.
        on_wait: Called about twice a second.

    Raises:
        DetectorError: There is no npm, or it fails, or it takes too long.
    """
    program = shutil.which("npm")
    elsewhere = f"run `npm pack {spec}` where it works and pass the file"
    if program is None:
        error = DetectorError(message("npm", "the program, to get a package", "none on PATH", elsewhere))
        raise error.hinted("--from FILE.tgz; npm comes with Node.js")
    words = [program, "pack", spec, *_SETTINGS]
    with open(folder / "npm.log", "w+b") as log:  # a file, which no child of npm can keep us waiting for
        status = _run(words, folder, log.fileno(), on_wait)
        log.seek(0, os.SEEK_END)
        log.seek(max(0, log.tell() - (1 << 16)))
        said = log.read().decode(errors="replace")
    if status is None:
        error = DetectorError(message(f"npm pack {spec}", f"an end within {LONGEST:g} s", "none", elsewhere))
        raise error.hinted("--from FILE.tgz")
    files = sorted(folder.glob("*.tgz"))
    if status or len(files) != 1:
        got = _reason(said) or (f"exit status {status}" if status else f"{len(files)} files")
        raise DetectorError(message(f"npm pack {spec}", "one .tgz file", got, elsewhere)).hinted("--from FILE.tgz")
    return files[0]


def _run(words: list[str], folder: Path, log: int, on_wait: Callable[[], None]) -> int | None:
    """Run a program in a folder; its exit status, or None if it was stopped because it took too long."""
    end = time.monotonic() + LONGEST
    process = subprocess.Popen(words, cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    try:
        while time.monotonic() < end:
            try:
                return process.wait(0.5)
            except subprocess.TimeoutExpired:
                on_wait()
        return None
    finally:
        process.kill()  # nothing happens to one that has ended
        process.wait()


def _reason(said: str) -> str:
    """What npm says went wrong, in a line."""
    lines = re.findall(r"^npm (?:error|ERR!) ?(.*)$", said, flags=re.MULTILINE)
    code = next((line.split()[1] for line in lines if line.startswith("code ") and len(line.split()) > 1), "")
    told = " ".join(line.strip() for line in lines if line.strip() and not line.startswith(("code ", "A complete log")))
    if code in _NO_NETWORK:
        return f"no way to its registry ({code})"
    if code in _NO_PACKAGE:
        return f"a registry that does not have it ({code})"
    if not lines:
        told = " ".join(said.split())
    return f"{code} {told}".strip()[:_SHOWN]
