"""The judge of the gate: has a process read a file, and makes a verdict of what it
finds, whatever becomes of it.

Nothing of a stranger's file is read here. What the process says is JSON of bounded
size, and a verdict holds even where it cannot be kept.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from mi_splat.audit.gate import CLAIMS, FILE, RESULT, GateConfig, Policy
from mi_splat.errors import MiSplatError, one_line, shortened
from mi_splat.import_closure import code_digest
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger.job import Task
from mi_splat.ledger.store import FILES, Store
from mi_splat.process_group import GroupEndedError, Limits, ProcessGroup

READER = "attacks.audits.gated"
"""The module that reads files, as a process."""
_STARTING = Limits(seconds=120.0)  # what a process may take to import its packages
_MESSAGES = DocumentReader(
    expected="a message of the process that reads", do="report this", most=1 << 26
)
_LONGEST = 600  # signs of why a file was not judged
_ENDING = re.compile(r"\.[a-z0-9]{1,10}")

Message = dict[str, Any]


class Reader(Protocol):
    """What answers requests; see `attacks.audits.gated.answer`."""

    def ask(self, request: Mapping[str, Any]) -> None:
        """Send a request."""
        ...

    def go_on(self, is_new: bool) -> None:
        """Say whether the contents that were read are to be judged."""
        ...

    def answer(self) -> Message:
        """The next message; `GroupEndedError` if there is none because of what the file
        did.
        """
        ...

    def end(self, *, for_good: bool) -> None:
        """A file is judged; `for_good` if nothing more is to be read by the same
        process.
        """
        ...

    def close(self) -> None:
        """End what is being read at once, also from another thread; nothing is read any
        more.
        """
        ...


class ReaderProcess:
    """A process group that reads files one after the other; a new one where a file has
    ended it.
    """

    def __init__(
        self,
        limits: Limits,
        *,
        environment: Mapping[str, str],
        cores: Sequence[int] = (),
    ) -> None:
        self._limits = limits
        self._environment = environment
        self._words = [",".join(map(str, cores)), str(limits.megabytes)]
        self._group: ProcessGroup | None = None
        self._since = 0.0
        self._starting = threading.Lock()
        self._is_closed = False

    def ask(self, request: Mapping[str, Any]) -> None:
        """Send a request; the time of its file begins."""
        group = self._started()
        self._since = time.monotonic()
        self._send(group, request)

    def go_on(self, is_new: bool) -> None:
        """Say whether the contents that were read are to be judged."""
        self._send(self._living(), is_new)

    def _send(self, group: ProcessGroup, value: object) -> None:
        try:
            group.pipe.send_bytes(json.dumps(value).encode())
        except OSError as error:
            raise group.ended() from error

    def _living(self) -> ProcessGroup:
        if self._group is None:
            raise GroupEndedError("the gate was closed")
        return self._group

    def answer(self) -> Message:
        """The next message of the process."""
        return self._next(self._living(), self._limits)

    def _next(self, group: ProcessGroup, limits: Limits) -> Message:
        group.wait(limits, self._since)
        try:
            data = group.pipe.recv_bytes(_MESSAGES.most)
        except (EOFError, OSError) as error:
            raise group.ended() from error
        return _MESSAGES.json_object(data, "reader")

    def end(self, *, for_good: bool) -> None:
        """Keep the process for the next file, unless it holds on to memory or has left
        others behind.
        """
        group = self._group
        if group is None:
            return
        most = self._limits.megabytes
        is_heavy = most is not None and group.megabytes() > most / 2
        if for_good or is_heavy or not group.is_alone():
            self._leave()

    def close(self) -> None:
        """End the process at once, also while another thread waits for it."""
        with self._starting:
            self._is_closed = True
            group = self._group
        if group is not None:
            group.close()

    def _leave(self) -> None:
        if self._group is not None:
            self._group.close()
            self._group = None

    def _started(self) -> ProcessGroup:
        if self._group is not None and self._group.is_running:
            return self._group
        self._leave()
        with self._starting:
            if self._is_closed:
                raise GroupEndedError("the gate was closed")
            self._group = ProcessGroup(
                READER, *self._words, environment=self._environment
            )
        self._since = time.monotonic()
        self._next(self._group, _STARTING)
        return self._group


@dataclass(kw_only=True)
class Judged:
    """What is known of a file."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    account: dict[str, Any] | None = None  # of the audit
    contents: dict[str, str] = field(default_factory=dict)  # SHA-256 by role
    record: str | None = None  # path of the account in the store
    error: str = ""  # why the rest was not judged


class Judge:
    """Judges one file after the other by a policy; verdicts are kept in a store by what
    the files hold.
    """

    def __init__(self, reader: Reader, policy: Policy, store: Store) -> None:
        self._reader = reader
        self._policy = policy
        self._store = store

    def judge(self, request: Mapping[str, str]) -> Judged:
        """What is found in a file; nothing that a file does is raised.

        Args:
            request: The path `file`, and where an older copy is known to be clean,
                `against`.

        Returns:
            What was found, with `FILE` in place of the file's name.
        """
        judged = Judged(error=request.get("error", ""))
        if judged.error:
            return judged
        is_whole = False
        try:
            self._read(request, judged)
            is_whole = True
        except Exception as error:  # noqa: BLE001
            # whatever it is, it concerns this file alone
            judged.error = (
                shortened(" ".join(str(error).split()), _LONGEST)
                or type(error).__name__
            )
        self._reader.end(for_good=not is_whole)
        return judged

    def _read(self, request: Mapping[str, str], judged: Judged) -> None:
        config = GateConfig(
            claims=self._policy.claims,
            most_gaussians=self._policy.most_gaussians,
            bounded=self._policy.bounded,
            ending=ending_of(request["file"]),
        )
        files = {"splat": request["file"]}
        if "against" in request:
            files["clean"] = request["against"]
        self._reader.ask(
            {
                "files": files,
                "config": dataclasses.asdict(config),
                "file_megabytes": self._policy.file_megabytes,
            }
        )
        while True:
            message = self._reader.answer()
            if message["state"] == "read":
                judged.contents = {
                    role: str(message["contents"][role]) for role in files
                }
                # the process that compares directions knows what it has
                has_features = bool(message.get("features"))
                config = dataclasses.replace(config, features=has_features)
                is_known = self._find(config, judged)
                self._reader.go_on(not is_known)
                if is_known:
                    return
            elif message["state"] == "row":
                judged.rows.append(_checked_row(message["row"]))
            elif message["state"] == "account":
                judged.account = message["account"]
            elif message["state"] == "failed":
                judged.error = str(message["error"])
                judged.rows.clear()  # they may be of two contents
                return
            else:
                self._keep(config, judged)
                return

    def _find(self, config: GateConfig, judged: Judged) -> bool:
        """Take what the store knows of a content; whether it knows any."""
        done = self._store.done(task_of(config, judged).key)
        if done is None:
            return False
        judged.rows = [dict(row) for row in done.rows]
        self._name_record(done.folder, judged)
        if judged.record is not None:
            judged.account = DocumentReader(most=1 << 28).read_json(Path(judged.record))
        return True

    def _keep(self, config: GateConfig, judged: Judged) -> None:
        """Keep what was found; a disk that is full takes no verdict away."""
        task = task_of(config, judged)
        documents = {} if judged.account is None else {RESULT: judged.account}
        try:
            self._store.keep(task, judged.rows, documents)
        except (MiSplatError, OSError):
            return
        self._name_record(self._store.folder_of(task.key) / FILES, judged)

    def _name_record(self, folder: Path, judged: Judged) -> None:
        record = folder / RESULT
        judged.record = str(record) if record.is_file() else None


def _checked_row(row: Any) -> dict[str, Any]:
    """A row of the process that reads, which may say anything once a file has taken it
    over.
    """
    texts = [row[name] for name in ("claim", "rule", "severity", "reason")]
    others = [
        value for name, value in row.items() if name in ("fingerprint", "gaussians")
    ]
    is_good = (
        row["claim"] in CLAIMS
        and all(type(text) is str for text in texts)
        and type(row["judged"]) is bool
        and all(type(value) in (str, int) for value in others)
    )
    if not is_good:
        raise _MESSAGES.broken("reader", "another one", "a row of findings")
    return dict(row)


def task_of(config: GateConfig, judged: Judged) -> Task:
    """What the store knows a judged file by: its content, how it is judged, and the
    code that does it.
    """
    inputs = {role: {"content": content} for role, content in judged.contents.items()}
    return Task(kind=READER, config=config, inputs=inputs, code=code_digest(READER))


def ending_of(name: str) -> str:
    """What of a name says how a file is read; empty where it says nothing."""
    ending = os.path.splitext(name)[1].lower()
    if _ENDING.fullmatch(ending):
        return ending
    return ""


def named(text: str, file: str) -> str:
    """A text about a file with the file's name."""
    return text.replace(FILE, one_line(file, 200))
