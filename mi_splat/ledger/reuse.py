"""Results of older code that new code would make again to the bit: some are made, and if equal, the rest is taken."""

import os
import shutil
from collections import Counter
from dataclasses import dataclass

from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import closure, code_digest
from mi_splat.ledger.engines import Engine
from mi_splat.ledger.job import Outcome, Task
from mi_splat.ledger.store import FILES, Store, differences
from mi_splat.ledger.values import decoded, encoded


@dataclass(frozen=True, kw_only=True)
class Reuse:
    """What was taken over."""

    code: str
    verified: tuple[str, ...]
    taken: tuple[str, ...]


def reuse(store: Store, kind: str, engine: Engine, *, verify: int, reason: str) -> Reuse:
    """Take over the results of a kind that older code made, of the code that made most of them."""
    older = _older(store, kind)
    if not older:
        engine.close()
        return Reuse(code="", verified=(), taken=())
    code = Counter(record_code for _, _, record_code in older).most_common(1)[0][0]
    pairs = [(key, task) for key, task, record_code in older if record_code == code]
    chosen = {number * len(pairs) // max(1, verify) for number in range(verify)} if verify < len(pairs) else None
    rerun = [pair for number, pair in enumerate(pairs) if chosen is None or number in chosen]
    try:
        outcomes = [outcome.result() for outcome in [engine.submit(task) for _, task in rerun]]
    finally:
        engine.close()
    for (key, task), outcome in zip(rerun, outcomes, strict=True):
        _compare(store, key, task.key, outcome)
    verified = tuple(task.key for _, task in rerun)
    note = {"code": code, "verified": list(verified), "reason": reason}
    rest = [pair for pair in pairs if pair[1].key not in verified]
    for key, task in rest:
        _take(store, key, task, {**note, "from": key})
    return Reuse(code=code, verified=verified, taken=tuple(task.key for _, task in rest))


def _older(store: Store, kind: str) -> list[tuple[str, Task, str]]:
    """Key, today's task and code of every result of older code that today's code has not made."""
    older = []
    code, modules = code_digest(kind), closure(kind)
    for key in sorted(store.keys()):
        record = store.record(key)
        if record["kind"] == kind and record["code"] != code:
            config = encoded(decoded(record["config"], modules))
            task = Task(kind=kind, config=config, inputs=record["inputs"], code=code)
            if not store.has(task.key):
                older.append((key, task, str(record["code"])))
    return older


def _compare(store: Store, key: str, rerun_key: str, outcome: Outcome) -> None:
    """Raise unless a job that was made again is the older one."""
    do = "run the study: its results are other ones"
    if outcome.state != "done":
        raise InvalidValueError.of(f"job {rerun_key}", "a result under today's code", outcome.text, do)
    names = differences(store.existing(key).record, store.existing(rerun_key).record)
    if names:
        raise InvalidValueError.of(f"job {rerun_key}", f"the bytes of {key}", f"another {', '.join(names)}", do)


def _take(store: Store, key: str, task: Task, note: dict[str, object]) -> None:
    """The result of an older job as that of a new one; the disk holds its files once, where it can."""
    done = store.existing(key)
    with store.held(task.key), store.making(task.key) as (temporary, _):
        for name in done.record["files"]:
            target = temporary / FILES / name
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(done.folder / name, target)
            except OSError:
                shutil.copy2(done.folder / name, target)
        record = {**done.record, "config": task.config, "inputs": task.inputs, "code": task.code, "reused": note}
        store.publish(temporary, record, task.key)
