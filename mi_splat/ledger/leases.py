"""Who does a job now: a file for each job that is being done, which no clock of another machine can make old."""

import contextlib
import json
import os
import platform
import secrets
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger.job import HeldError

HEARTBEAT, STALE = 30.0, 120.0
"""Seconds between two signs of life of a running job, and after how many without one it counts as dead elsewhere."""


def boot_id() -> str:
    """What tells this start of this machine from all others; empty where the system has no name for it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def start_of(process: int) -> str | None:
    """When a process of this machine began, as the system counts; None if it has ended, "" where that is not told."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        if os.path.isdir("/proc/self"):
            return None
        try:
            os.kill(process, 0)
        except PermissionError:
            return ""
        except (OSError, OverflowError):
            return None
        return ""
    return None if fields[0] in "ZX" else fields[19]


@dataclass(frozen=True, kw_only=True)
class Leases:
    """The leases of a store.

    Attributes:
        folder: Where they are.
        seen: For leases of other machines: their last sign of life, and when this process saw it first.
    """

    folder: Path
    seen: dict[str, tuple[tuple[int, int], float]] = field(default_factory=dict)

    @contextlib.contextmanager
    def held(self, key: str) -> Iterator[None]:
        """Have a job for this process alone while the body runs."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path, token = self.folder / key, secrets.token_hex(8)
        with self._alone():
            if (holder := self.holder(key)) is not None:
                raise HeldError.of(f"job {key}", "one that nobody does", holder, "wait for its end")
            _write(path, token)
        _keep_alive(path)
        try:
            yield
        finally:
            _HELD.discard(path)
            with self._alone():
                if _read(path).get("token") == token:
                    path.unlink(missing_ok=True)

    def holder(self, key: str) -> str | None:
        """Who does a job now, in words; None for nobody, also where who did it has died."""
        path = self.folder / key
        try:
            status = path.stat()
        except OSError:
            self.seen.pop(key, None)
            return None
        lease = _read(path)
        who = f"process {lease.get('process')} of {lease.get('host')}"
        if (
            lease.get("host") == platform.node()
            and lease.get("boot") == boot_id()
            and isinstance(lease.get("process"), int)
        ):
            return who if start_of(lease["process"]) == lease.get("start") else None
        now, sign = time.monotonic(), (status.st_mtime_ns, status.st_ino)
        if self.seen.get(key, (None,))[0] != sign:
            self.seen[key] = (sign, now)
        return who if now - self.seen[key][1] < STALE else None

    def live(self) -> set[str]:
        """Keys of the jobs that are being done; the leases of the dead are removed."""
        names = os.listdir(self.folder) if self.folder.is_dir() else []
        return {name for name in names if not name.startswith(".") and not self.free(name)}

    def free(self, key: str) -> bool:
        """Whether nobody does a job now; the lease of one who has died is removed, so that others need not judge it."""
        path = self.folder / key
        if path.exists() and self.holder(key) is None:
            with self._alone():
                if self.holder(key) is None:
                    path.unlink(missing_ok=True)
        return not path.exists()

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Leases are taken, given back and judged by one process at a time, where the disk has locks."""
        try:
            import fcntl
        except ImportError:
            yield
            return
        descriptor = os.open(self.folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            with contextlib.suppress(OSError):  # a disk without locks
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)


def _write(path: Path, token: str) -> None:
    """Write a lease, which appears whole."""
    lease = {
        "host": platform.node(),
        "boot": boot_id(),
        "process": os.getpid(),
        "start": start_of(os.getpid()),
        "token": token,
    }
    temporary = path.with_name(f".{path.name}.{token}")
    try:
        temporary.write_text(json.dumps(lease))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _read(path: Path) -> dict[str, Any]:
    """What a lease says; nothing if it is gone or broken."""
    try:
        return DocumentReader(most=4096).read_json(path)
    except InvalidValueError:
        return {}


_HELD = set[Path]()
_BEAT = threading.Lock()


def _keep_alive(path: Path) -> None:
    """Make a thread touch a lease from now on, until it is no more in `_HELD`."""
    with _BEAT:
        _HELD.add(path)
        if not any(thread.name == _beat.__name__ for thread in threading.enumerate()):
            threading.Thread(target=_beat, name=_beat.__name__, daemon=True).start()


def _beat() -> None:
    while True:
        time.sleep(HEARTBEAT)
        for path in list(_HELD):
            with contextlib.suppress(OSError):
                os.utime(path)
