"""`mi-splat gate`: verdicts on many splat files, which are read by processes with
limits.

A verdict counts before it is shown: whether anybody can read it changes no exit status.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import itertools
import json
import queue
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from attacks.cli.options import chosen_workers
from mi_splat.audit.gate import ACTIONS, CLAIMS, VERDICTS, Policy
from mi_splat.cli.console import UsageError, show, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions
from mi_splat.errors import MiSplatError, one_line
from mi_splat.fields import OutFile, OutFolder, at_least, between, check_choice, decode
from mi_splat.io.parsing import DocumentReader

if TYPE_CHECKING:
    from attacks.audits.judging import Judge, Judged, Reader
    from mi_splat.ledger import Store

EXAMPLES = (
    "gate YOUR_SCENE.ply OTHER.spz --strict",
    "gate --policy policy.toml --json",
    "gate YOUR_SCENE.ply --only lint --strict",
)
REFUSED = 3
UNJUDGED = 1
"""Exit status with --strict where a file is refused, and where one is not judged."""
ENDINGS = (".sarif", ".json")
_WAITING = 4  # files for each process that wait for it
_LONGEST_LINE = (1 << 16) + 2
_LINES = DocumentReader(
    expected='a JSON text, or an object with "file"',
    do="write one path a line",
    most=1 << 16,
)

Request = Mapping[str, str]
Line = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class GateOptions(JsonOptions):
    """Give a verdict on each file, claim by claim: accept, quarantine, not judged or
    refuse.

    Without files, paths are read from standard input, one JSON text a line, or an
    object with "file" and, where an older copy is known to be clean, "against". A
    verdict is written as soon as its file ends; with --json it is one JSON object in
    one line. A file that is larger, or takes more time or memory, than the policy
    allows, or that ends the process that reads it, is not judged, and the others are.
    Verdicts are kept in --store by what a file holds, so that no content is judged
    twice; its name is not kept.

    Exit status with --strict: 3 a file is refused, 1 none is refused but one is not
    judged, or a verdict could not be written.
    """

    files: Positional[tuple[Path, ...]] = ()
    """Splat files of any format that is read, and folders of images with cameras."""
    policy: Path | None = None
    """TOML file: `seconds` and `megabytes` of memory for a file, `file_megabytes` on
    the disk, `most_gaussians` that are looked at for appearances, the
    `claims` to judge, how far colours may depart with the direction (`bounded`, see
    `mi-splat bound`), and under [rules] what follows from a rule or a severity: accept,
    quarantine or refuse. Without, errors and contradicted files are refused.
    """
    only: Literal["lint"] | None = None
    """Only check the numbers and what rendering them costs, which is much faster."""
    workers: Annotated[int, between(1, 1024, "processes")] | None = None
    """Processes that read files side by side. Default: one for each core if memory
    allows.
    """
    seconds: Annotated[float, at_least(1, "seconds")] | None = None
    """Most seconds that a file may take, in place of those of the policy (120)."""
    megabytes: Annotated[float, at_least(500, "MB")] | None = None
    """Most memory that all processes that read a file may use together, in place of
    that of the policy (4000).
    """
    store: OutFolder = Path("~/.cache/mi-splat")
    """Folder of verdicts, and of the records on which they rest."""
    sarif: OutFile | None = None
    """Write what was found as SARIF 2.1.0, too, once all files are judged."""
    force: bool = False
    """Replace a SARIF file that is there."""
    strict: bool = False
    """Let the exit status say whether all files passed."""


def run(options: GateOptions) -> int:
    """Judge every file; verdicts come in the order in which files end."""
    from mi_splat.io.folders import check_new_file
    from mi_splat.ledger import Store

    policy = _policy(options)
    if options.sarif is not None:
        check_new_file(options.sarif, ENDINGS, force=options.force)
    requests = _requests(options.files)
    store = Store(options.store.expanduser())
    # verdicts can be given where none can be kept
    with contextlib.suppress(MiSplatError, OSError):
        store.sweep()
    verdicts = _Verdicts(options)
    with _readers(chosen_workers(options.workers), policy, store) as readers:
        _judge_all(requests, readers, policy, store, verdicts)
    return verdicts.end()


def _judge_all(
    requests: Iterator[Request],
    readers: Sequence[Reader],
    policy: Policy,
    store: Store,
    verdicts: _Verdicts,
) -> None:
    """Judge files side by side, one for each reader."""
    from attacks.audits.judging import Judge

    waiting: queue.Queue[Request | None] = queue.Queue(_WAITING * len(readers))
    threads = []
    for reader in readers:
        words = (waiting, Judge(reader, policy, store), policy, verdicts)
        # A thread that is in the middle of something must not hold up an interruption.
        threads.append(threading.Thread(target=_judge_from, args=words, daemon=True))
    for thread in threads:
        thread.start()
    try:
        for request in requests:
            waiting.put(request)
        for _ in threads:
            waiting.put(None)
        for thread in threads:
            thread.join()
    except BaseException:
        verdicts.stop()
        raise


def _judge_from(
    waiting: queue.Queue[Request | None],
    judge: Judge,
    policy: Policy,
    verdicts: _Verdicts,
) -> None:
    """Judge one waiting file after the other; nothing that happens to one ends this."""
    while (request := waiting.get()) is not None:
        started = time.monotonic()
        try:
            judged = judge.judge(request)
            verdicts.add(request["file"], judged, policy, time.monotonic() - started)
        except BaseException as error:  # noqa: BLE001
            # it counts as a file that is not judged
            verdicts.lose(error)


@contextlib.contextmanager
def _readers(workers: int, policy: Policy, store: Store) -> Iterator[list[Reader]]:
    """Processes that read, each with its share of the cores and its own folder of
    compiled kernels.
    """
    from attacks.audits.judging import ReaderProcess
    from mi_splat.process_group import Limits
    from mi_splat.processes import own_cores, share_of_cores

    limits = Limits(seconds=policy.seconds, megabytes=policy.megabytes)
    readers = list[ReaderProcess]()
    with contextlib.ExitStack() as caches:
        numbers = itertools.count()
        for worker in range(workers):
            try:
                kernels = store.free_kernels(numbers, caches)
            except MiSplatError:  # verdicts can be given where none can be kept
                kernels = Path(caches.enter_context(tempfile.TemporaryDirectory()))
            variables = {
                "OMP_NUM_THREADS": "1",
                "MKL_NUM_THREADS": "1",
                "DRJIT_CACHE_DIR": str(kernels),
            }
            cores = share_of_cores(own_cores(), worker, workers)
            readers.append(ReaderProcess(limits, environment=variables, cores=cores))
        try:
            yield list(readers)
        finally:
            for reader in readers:
                reader.close()


class _Verdicts:
    """The verdicts of a run: each counts first, and is then shown where that is
    possible.
    """

    def __init__(self, options: GateOptions) -> None:
        self._options = options
        self._lock = threading.Lock()
        self._found = set[str]()
        self._reports = list[Mapping[str, Any]]()
        self._fault: Exception | None = None
        self._is_stopped = False

    def stop(self) -> None:
        """Take no more: what is ended now is ended because of us, and says nothing of a
        file.
        """
        self._is_stopped = True

    def add(self, file: str, judged: Judged, policy: Policy, seconds: float) -> None:
        """A file is judged."""
        line = _line(file, judged, policy, seconds)
        with self._lock:
            if self._is_stopped:
                return
            self._found.add(line["verdict"])
            if self._options.sarif is not None:
                self._reports.append(_report(line, judged))
            self._show(json.dumps(line) if self._options.json else _in_words(line))

    def lose(self, error: BaseException) -> None:
        """A file has no verdict because of a fault of this program."""
        with self._lock:
            if self._is_stopped:
                return
            self._found.add("not judged")
            warn(f"no verdict on a file: {one_line(str(error))}; report this")

    def _show(self, text: str) -> None:
        if self._fault is not None:
            return
        try:
            show(text)
            sys.stdout.flush()
        except (OSError, ValueError) as error:  # also of a stdout that is closed
            self._fault = error

    def end(self) -> int:
        """Write what is written at the end; the exit status."""
        status = 0
        if self._fault is not None and not isinstance(self._fault, BrokenPipeError):
            warn(
                f"verdicts could not be written: {self._fault}; the files were judged"
                " all the same"
            )
            status = UNJUDGED
        if self._options.sarif is not None:
            status = max(status, self._save_sarif(self._options.sarif))
        if not self._options.strict:
            return status
        if self._fault is not None or "not judged" in self._found:
            status = UNJUDGED
        if "refuse" in self._found:
            return REFUSED
        return status

    def _save_sarif(self, path: Path) -> int:
        from mi_splat.audit.sarif import sarif
        from mi_splat.io.documents import save_json

        try:
            save_json(sarif(self._reports), path)
        except MiSplatError as error:
            warn(str(error))
            return UNJUDGED
        return 0


def _policy(options: GateOptions) -> Policy:
    from mi_splat.audit.rules import ADDED, RULES

    reader = DocumentReader(expected="a policy as TOML", do="see mi-splat help gate")
    table = {} if options.policy is None else reader.read_toml(options.policy)
    policy = decode(Policy, table, str(options.policy))
    known = [
        *ACTIONS,
        "overdraw",
        "render-mode",
        "unreadable",
        *(rule.name for rule in RULES),
        *ADDED,
    ]
    for name in policy.rules:
        if not name.startswith("gltf-"):
            check_choice(f"rules in {options.policy}", name, known)
    return replace(
        policy,
        claims=CLAIMS[:3] if options.only else policy.claims,
        seconds=options.seconds or policy.seconds,
        megabytes=options.megabytes or policy.megabytes,
    )


def _requests(files: Sequence[Path]) -> Iterator[Request]:
    """What is to be judged: the files, or what standard input names; a line that names
    none has its reason.
    """
    if files:
        return ({"file": str(path)} for path in files)
    if sys.stdin is None:
        raise UsageError.of(
            "files",
            "paths, or a standard input that names them",
            "a closed one",
            "pass paths",
        )
    return map(_request, filter(str.strip, _input_lines()))


def _request(line: str) -> Request:
    """The request in a line of standard input."""
    try:
        value = _LINES.json_value(
            line.encode("utf-8", "surrogateescape"), "standard input"
        )
        request = {"file": value} if isinstance(value, str) else value
        if (
            not isinstance(request, dict)
            or "file" not in request
            or not request.keys() <= {"file", "against"}
        ):
            raise _LINES.broken("standard input", one_line(line, 80))
        return {key: str(text) for key, text in request.items()}
    except MiSplatError as error:
        return {"file": line.strip()[:80], "error": str(error)}


def _input_lines() -> Iterator[str]:
    """Lines of standard input, of long ones the beginning; one that is no UTF-8 is a
    line, too.
    """
    stream: Any = (
        sys.stdin.buffer if isinstance(sys.stdin, io.TextIOWrapper) else sys.stdin
    )
    while line := stream.readline(_LONGEST_LINE):
        yield line if isinstance(line, str) else line.decode("utf-8", "surrogateescape")
        while len(line) == _LONGEST_LINE and line[-1:] not in ("\n", b"\n"):
            line = stream.readline(_LONGEST_LINE)


def _line(file: str, judged: Judged, policy: Policy, seconds: float) -> Line:
    """The verdict on a file, as it is shown."""
    from attacks.audits.judging import READER, named
    from mi_splat.import_closure import code_digest

    line = policy.verdict(judged.rows)
    # also where every claim had been judged before: a file that ends its process passes
    # nowhere
    if judged.error:
        line["verdict"] = max(line["verdict"], "not judged", key=VERDICTS.index)
    for values in line["claims"].values():
        for reason in values["reasons"]:
            reason["reason"] = named(reason["reason"], file)
    known: Line = dict.fromkeys(("fingerprint", "gaussians"))
    for row in judged.rows:
        known |= {key: row[key] for key in known if key in row}
    return {
        "file": file,
        **line,
        "error": named(judged.error, file) or None,
        **known,
        "looked_at": min(known["gaussians"] or 0, policy.most_gaussians),
        "sha256": judged.contents.get("splat"),
        "record": judged.record,
        "tool": f"mi-splat {importlib.metadata.version('mi-splat')}",
        "code": code_digest(READER),
        "seconds": round(seconds, 3),
    }


def _in_words(line: Line) -> str:
    parts = [
        f"{line['file']}: {line['verdict']}",
        *([f"  {line['error']}"] if line["error"] else []),
    ]
    for claim, values in line["claims"].items():
        parts += [
            f"  {claim}, {item['verdict']}: {item['rule']} {item['reason']}"
            for item in values["reasons"]
        ]
    # a name must not make up lines of its own
    return "\n".join("\\n".join(part.splitlines()) for part in parts)


def _report(line: Line, judged: Judged) -> Mapping[str, Any]:
    """What SARIF says of a file: what the audit found, and what of the verdict does not
    follow from that.
    """
    told = ("unreadable", "changed", "") if judged.account else None
    more = []
    for claim, values in line["claims"].items():
        for item in values["reasons"]:
            if told is None or item["rule"] in told:
                rule = item["rule"] or "not-judged"
                more.append(
                    (rule, item["severity"] or "warning", f"{claim}: {item['reason']}")
                )
    if line["error"] or not (more or judged.account):
        more.append(
            (
                "not-judged",
                "error",
                line["error"] or "nothing was found out about the file",
            )
        )
    account = judged.account or {"summary": []}
    return {**account, "file": line["file"], "verdict": line["verdict"], "more": more}
