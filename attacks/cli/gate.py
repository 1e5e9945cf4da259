"""`mi-splat gate`: verdicts on many splat files, each judged in a process that it cannot take others down with."""

from __future__ import annotations

import importlib.metadata
import io
import json
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from attacks.cli.study import JobOptions, engine_of
from mi_splat.audit.gate import ACTIONS, CLAIMS, RESULT, ROWS, GateConfig, Policy
from mi_splat.cli.console import show
from mi_splat.cli.flags import Positional
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.fields import OutFile, OutFolder, check_choice, decode
from mi_splat.io.parsing import DocumentReader

if TYPE_CHECKING:
    from mi_splat.ledger import Store
    from mi_splat.ledger.engines import Engine
    from mi_splat.ledger.job import Task

EXAMPLES = (
    "gate YOUR_SCENE.ply OTHER.spz --strict",
    "gate --policy policy.toml --json",
    "gate YOUR_SCENE.ply --only lint --strict",
)
KIND = "attacks.audits.gated"
REFUSED, UNJUDGED = 3, 1
"""Exit status with --strict where a file is refused, and where one is not judged."""
ENDINGS = (".sarif", ".json")
_POLL = 0.2  # seconds between two looks at a file that another process judges
_LINES = DocumentReader(expected='a JSON text, or an object with "file"', do="write one path a line", most=1 << 16)

Request = Mapping[str, str]
Line = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class GateOptions(JobOptions):
    """Give a verdict on each file, claim by claim: accept, quarantine, not judged or refuse.

    Without files, paths are read from standard input, one JSON text a line, or an object with "file" and, where an
    older copy is known to be clean, "against". A verdict is written as soon as its file ends; with --json it is one
    JSON object in one line. A file that takes more time or memory than the policy allows, or that ends its process, is
    not judged, and the others are. Verdicts are kept in --store, so that no file is judged twice.

    Exit status with --strict: 3 a file is refused, 1 none is refused but one is not judged.
    """

    files: Positional[tuple[Path, ...]] = ()
    """Splat files of any format that is read."""
    policy: Path | None = None
    """TOML file: `seconds` and `megabytes` for a file, `most_gaussians` that are looked at for appearances and edits,
    the `claims` to judge, and under [rules] what follows from a rule or a severity: accept, quarantine or refuse.
    Without, errors and hidden appearances are refused, suspicious ones and edits quarantined."""
    only: Literal["lint"] | None = None
    """Only check the numbers and what rendering them costs, which is much faster."""
    store: OutFolder = Path("~/.cache/mi-splat")
    """Folder of verdicts, and of the records on which they rest."""
    sarif: OutFile | None = None
    """Write what was found as SARIF 2.1.0, too, once all files are judged."""
    strict: bool = False
    """Let the exit status say whether all files passed."""


def run(options: GateOptions) -> int:
    """Judge every file; verdicts come in the order in which files end."""
    from mi_splat.io.folders import check_new_file

    policy = _policy(options)
    seconds, megabytes = options.seconds or policy.seconds, options.megabytes or policy.megabytes
    options = replace(options, store=options.store.expanduser(), seconds=seconds, megabytes=megabytes)
    if options.sarif is not None:
        check_new_file(options.sarif, ENDINGS, force=True)
    engine, printing, lines = engine_of(options, lambda event: None), threading.Lock(), list[Line]()

    def judge(request: Request) -> None:
        line = {"file": request["file"], **_judged(request, policy, engine, options.store)}
        with printing:
            show(json.dumps(line) if options.json else _in_words(line))
            sys.stdout.flush()
            lines.append(line)

    try:
        with ThreadPoolExecutor(engine.window) as pool:
            try:
                room = threading.Semaphore(4 * engine.window)
                for request in _requests(options.files):
                    room.acquire()
                    pool.submit(judge, request).add_done_callback(lambda _: room.release())
            except BaseException:
                engine.close()  # else the pool waits for what is being judged
                raise
    finally:
        engine.close()
    if options.sarif is not None:
        _save_sarif(lines, options.sarif)
    found = {line["verdict"] for line in lines} if options.strict else set()
    return REFUSED if "refuse" in found else UNJUDGED if "not judged" in found else 0


def _policy(options: GateOptions) -> Policy:
    from mi_splat.audit.rules import ADDED, RULES

    reader = DocumentReader(expected="a policy as TOML", do="see mi-splat help gate")
    table = {} if options.policy is None else reader.read_toml(options.policy)
    policy = decode(Policy, table, str(options.policy))
    known = [*ACTIONS, "hidden-look", "overdraw", "render-mode", "unreadable", *(rule.name for rule in RULES), *ADDED]
    for name in policy.rules:
        if not name.startswith("gltf-"):
            check_choice(f"rules in {options.policy}", name, known)
    return replace(policy, claims=CLAIMS[:3]) if options.only else policy


def _requests(files: Sequence[Path]) -> Iterator[Request]:
    """What is to be judged: the files, or what standard input names; a line that names none has its reason."""
    yield from ({"file": str(path)} for path in files)
    for line in filter(str.strip, _input_lines()) if not files else ():
        try:
            value = _LINES.json_value(line.encode("utf-8", "surrogateescape"), "standard input")
            request = {"file": value} if isinstance(value, str) else value
            if not isinstance(request, dict) or "file" not in request or not request.keys() <= {"file", "against"}:
                raise _LINES.broken("standard input", line.strip()[:80])
            yield {key: str(text) for key, text in request.items()}
        except MiSplatError as error:
            yield {"file": line.strip()[:80], "error": str(error)}


def _input_lines() -> Iterator[str]:
    """Lines of standard input; one that is no UTF-8 is a line, too."""
    if isinstance(sys.stdin, io.TextIOWrapper):
        yield from (line.decode("utf-8", "surrogateescape") for line in sys.stdin.buffer)
    else:
        yield from sys.stdin


def _judged(request: Request, policy: Policy, engine: Engine, folder: Path) -> Line:
    """The verdict on a file; nothing that a file does is raised."""
    from mi_splat.import_closure import code_digest
    from mi_splat.ledger import Job, Store
    from mi_splat.ledger.running import task_for

    begun, store = time.monotonic(), Store(folder)
    known: Line = dict.fromkeys(("fingerprint", "gaussians", "looked_at", "sha256", "record"))
    rows: Sequence[Mapping[str, Any]] = ()
    why = request.get("error", "")
    try:
        paths = {"splat": request["file"], "clean": request.get("against", request["file"])}
        inputs = {name: _regular(path) for name, path in paths.items() if name == "splat" or "against" in request}
        config = GateConfig(claims=policy.claims, most_gaussians=policy.most_gaussians, ending=inputs["splat"].suffix)
        task = task_for(Job(kind=KIND, config=config, inputs=inputs), store, {})
        known["sha256"] = task.inputs["splat"]["content"]
        rows, why, known["record"] = _ended(task, engine, store)
    except Exception as error:  # noqa: BLE001  # whatever it is, it concerns this file alone
        why = why or " ".join(str(error).split())
    known |= {key: row[key] for row in rows for key in ("fingerprint", "gaussians") if key in row}
    known["looked_at"] = min(known["gaussians"] or 0, policy.most_gaussians)
    tool = {"tool": f"mi-splat {importlib.metadata.version('mi-splat')}", "code": code_digest(KIND)}
    return {
        **policy.verdict(rows),
        "error": why or None,
        **known,
        **tool,
        "seconds": round(time.monotonic() - begun, 3),
    }


def _regular(name: str) -> Path:
    """A path, unless reading it could wait for ever."""
    path = Path(name)
    if not path.is_file():
        raise InvalidValueError.of(name, "a regular file", "none there", "pass the path of a splat file")
    return path


def _ended(task: Task, engine: Engine, store: Store) -> tuple[Sequence[Mapping[str, Any]], str, str | None]:
    """What was found in a file, why the rest was not judged, and where the record is."""
    while (outcome := engine.submit(task).result()).state == "held":
        time.sleep(_POLL)
    if (done := store.done(task.key)) is not None:
        record = done.folder / RESULT
        return done.rows, "", str(record) if record.is_file() else None
    kept = store.path("partial", task.key)
    rows = DocumentReader().read_json(kept / ROWS)["rows"] if (kept / ROWS).is_file() else []
    shutil.rmtree(kept, ignore_errors=True)
    store.forgive(task.key)
    return rows, outcome.text.removeprefix("try 1: "), None


def _in_words(line: Line) -> str:
    parts = [f"{line['file']}: {line['verdict']}", *([f"  {line['error']}"] if line["error"] else [])]
    for claim, values in line["claims"].items():
        parts += [f"  {claim}, {item['verdict']}: {item['rule']} {item['reason']}" for item in values["reasons"]]
    return "\n".join("\\n".join(part.splitlines()) for part in parts)  # a name must not make up lines of its own


def _save_sarif(lines: Sequence[Line], path: Path) -> None:
    from mi_splat.audit.files import sarif
    from mi_splat.io.documents import save_json
    from mi_splat.io.parsing import read_json

    documents = []
    for line in lines:
        reasons = [item["reason"] for values in line["claims"].values() for item in values["reasons"]]
        unread = {"verdict": None, "error": line["error"] or " ".join(reasons)}
        documents.append({"file": line["file"], **(read_json(Path(line["record"])) if line["record"] else unread)})
    save_json(sarif(documents), path)
