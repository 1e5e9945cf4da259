"""The folder of results: a second result, what varies, a full disk, what a killed
process leaves.
"""

import builtins
import contextlib
import dataclasses
import errno
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import closure
from mi_splat.io.documents import sha256
from mi_splat.io.errors import SplatFileError
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Event, Job, running
from mi_splat.ledger.job import DiskFullError, Task, digest
from mi_splat.ledger.running import run_job, task_for
from mi_splat.ledger.states import note_keys, planned
from mi_splat.ledger.store import Store, content_of_path, record_text
from tests.ledger.drive import Ledger, walk
from tests.ledger.kinds.configs import NumbersConfig, Sign

NUMBERS = "tests.ledger.kinds.numbers"


def test_a_second_result_is_dropped(tmp_path: Path) -> None:
    """A job that another process finishes first, on a disk without locks, with other
    bytes.
    """
    task = task_for(Job(kind=NUMBERS, config=NumbersConfig()), Store(tmp_path), {})
    store = Store(tmp_path / "store")
    other = Store(tmp_path / "other")
    run_job(other, task)
    folder = other.folder_of(task.key)
    (folder / "files" / "sum.txt").write_text("7")
    record = record_text(
        read_json(folder / "job.json"),
        {"sum.txt": sha256(folder / "files" / "sum.txt")},
    )
    (folder / "job.json").write_text(record)

    def tell(event: Event) -> None:
        if event.state == "progress":
            shutil.copytree(folder, store.folder_of(task.key))

    assert run_job(store, task, tell).state == "done"
    assert (store.existing(task.key).folder / "sum.txt").read_text() == "7"


def test_rows_that_were_changed_are_an_error(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    done = ledger.do(Job(kind=NUMBERS, config=NumbersConfig()))
    record = ledger.store.folder_of(done.key) / "job.json"
    record.write_text(record.read_text().replace('[{"sum":1.0}]', '[{"sum":2.0}]'))
    with pytest.raises(InvalidValueError, match=r"expected the record of job"):
        Ledger(tmp_path).do(Job(kind=NUMBERS, config=NumbersConfig()))


def test_a_failed_job_goes_on_where_it_was(tmp_path: Path) -> None:
    steps: list[int] = []

    def interrupt(event: Event) -> None:
        if event.state == "progress":
            steps.append(event.done)
            if event.done == 3 and steps.count(3) == 1:
                raise InterruptedError("enough")

    ledger = Ledger(tmp_path / "interrupted", on_event=interrupt)
    with pytest.raises(InterruptedError):
        ledger.do(walk(7, steps=5))
    (failed,) = (tmp_path / "interrupted" / "failed").iterdir()
    assert "InterruptedError: enough" in failed.read_text()
    done = ledger.do(walk(7, steps=5))
    assert steps == [1, 2, 3, 4, 5]
    assert (
        done.record["files"]
        == Ledger(tmp_path / "whole").do(walk(7, steps=5)).record["files"]
    )
    assert not [
        *(tmp_path / "interrupted" / "failed").iterdir(),
        *(tmp_path / "interrupted" / "partial").iterdir(),
    ]


def test_a_full_disk_is_an_error_that_leaves_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "store"
    calls = 0
    at = 0

    def limited(
        real: Callable[..., Any], writes: Callable[..., bool]
    ) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            nonlocal calls
            if writes(*arguments, **options):
                calls += 1
                if calls >= at > 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return real(*arguments, **options)

        return call

    def opened_to_write(path: Any, mode: str = "r", *rest: Any, **options: Any) -> bool:
        return "w" in mode or "a" in mode

    everything: Callable[..., bool] = lambda *arguments, **options: True  # noqa: E731
    job = walk(3, steps=2, one=walk(1, steps=2))
    with monkeypatch.context() as patch:
        patch.setattr(builtins, "open", limited(open, opened_to_write))
        patch.setattr("io.open", limited(open, opened_to_write))
        for name in ("mkdir", "rename", "replace", "fsync"):
            patch.setattr(os, name, limited(getattr(os, name), everything))
        while len(Store(store).keys()) < 2:
            calls = 0
            at = at + 1
            with contextlib.suppress(DiskFullError):
                Ledger(store).do(job)
            calls = 0
            limit = at
            at = 0
            for key in Store(store).keys():  # noqa: SIM118 - not a dictionary's
                Store(store).existing(key)
            Store(store).sweep()
            left = [
                path
                for name in ("failed", "tmp", "locks")
                for path in (store / name).glob("*[!k]")
            ]
            assert left == [], (
                "a full disk is no fault of a job, and leaves nothing half-written"
            )
            at = limit
    assert at > 15


def test_what_killed_processes_leave_is_swept(tmp_path: Path) -> None:
    store = Store(tmp_path)
    done = Ledger(tmp_path).do(walk(1))
    unfinished = "f" * 32
    killed = [f"{folder}/.0123456789abcdef.tmp" for folder in ("tmp", "failed")]
    for name in (*killed, f"partial/{done.key}", f"partial/{unfinished}"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "rest").write_text("rest")
    for name in killed:
        os.utime(tmp_path / name, (time.time() - 90,) * 2)
    (tmp_path / "locks" / unfinished).write_text("")
    store.sweep()
    assert [path.name for path in (tmp_path / "partial").iterdir()] == [unfinished]
    assert not list((tmp_path / "locks").iterdir())
    assert not [*(tmp_path / "tmp").iterdir(), *(tmp_path / "failed").iterdir()]


def test_a_job_is_removed_and_made_again(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    key = ledger.do(walk(1)).key
    ledger.store.remove(key)
    ledger.store.remove(key)
    assert (
        ledger.store.keys(),
        ledger.store.done(key),
        [*(tmp_path / "tmp").iterdir()],
    ) == (set(), None, [])
    assert ledger.do(walk(1)).key == key


def test_the_content_of_a_path_is_that_of_its_files(tmp_path: Path) -> None:
    (tmp_path / "folder" / "in").mkdir(parents=True)
    (tmp_path / "folder" / "in" / "a").write_text("1")
    before = content_of_path(tmp_path / "folder")
    assert content_of_path(tmp_path / "folder") == before
    (tmp_path / "folder" / "in" / "a").rename(tmp_path / "folder" / "in" / "b")
    renamed = content_of_path(tmp_path / "folder")
    (tmp_path / "folder" / "in" / "b").write_text("22")
    assert len({before, renamed, content_of_path(tmp_path / "folder")}) == 3
    with pytest.raises(
        InvalidValueError, match="expected a file or a folder to read, got nothing"
    ):
        content_of_path(tmp_path / "nothing")


# Keys: every field flips the keys that depend on it and no other, and a configuration
# comes back from its text


OTHER: dict[str, Any] = {
    "values": (1.0, 2.0),
    "name": "total",
    "most": 0,
    "loud": True,
    "by": 0.5,
    "sign": Sign.MINUS,
}


def changed(config: Any) -> Iterator[tuple[str, Any]]:
    """The configuration with another value in each of its fields, those of its parts
    too.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from (
                (name, dataclasses.replace(config, **{field.name: part}))
                for name, part in changed(value)
            )
        else:
            yield (
                field.name,
                dataclasses.replace(config, **{field.name: OTHER[field.name]}),
            )


def keys(folder: Path, config: NumbersConfig) -> dict[str, str]:
    """Keys of a small graph of jobs, one of which has the configuration."""
    ledger = Ledger(folder)
    first = Job(kind=NUMBERS, config=config)
    beside = Job(kind=NUMBERS, config=NumbersConfig(values=(9.0,)))
    after = Job(kind=NUMBERS, config=NumbersConfig(), inputs={"first": first})
    jobs = {"first": first, "beside": beside, "after": after}
    return {name: ledger.do(job).key for name, job in jobs.items()}


def test_every_field_flips_exactly_the_keys_that_depend_on_it(tmp_path: Path) -> None:
    usual = keys(tmp_path, NumbersConfig())
    names = set()
    for name, config in changed(NumbersConfig()):
        flipped = {
            job for job, key in keys(tmp_path, config).items() if key != usual[job]
        }
        # What the job leaves is the same whatever these three say, and so is what reads
        # it.
        assert flipped == (
            {"first"}
            if name in ("name", "most", "loud", "sign")
            else {"first", "after"}
        ), name
        names.add(name)
    assert names == set(OTHER)


def test_the_code_of_its_kind_is_in_the_key_and_the_ledger_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not [name for name in closure(NUMBERS) if name.startswith("mi_splat.ledger")]
    usual = keys(tmp_path, NumbersConfig())
    monkeypatch.setattr(running, "code_digest", lambda kind: "0123456789abcdef")
    assert not set(keys(tmp_path, NumbersConfig()).values()) & set(usual.values())


def test_where_a_kind_and_its_configuration_lie_is_not_in_the_key() -> None:
    @dataclasses.dataclass(frozen=True)
    class Here:
        values: tuple[float, ...] = (1.0,)

    Here.__qualname__ = NumbersConfig.__qualname__
    there = type("There", (Here,), {})
    there.__qualname__ = NumbersConfig.__qualname__
    there.__module__ = "elsewhere"
    keys = {
        Task(kind=kind, config=config, inputs={}, code="0").key
        for kind, config in ((NUMBERS, Here()), ("x", there()))
    }
    assert len(keys) == 1


def used(store: Store, key: str) -> list[Callable[[], object]]:
    """All that makes a path of a key."""
    return [
        lambda: store.has(key),
        lambda: store.failures(key),
        lambda: store.forgive(key),
        lambda: store.remove(key),
        lambda: store.making(key).__enter__(),
    ]


@pytest.mark.parametrize(
    "key", ["../victim", "0" * 31, "0" * 33, "A" * 32, f"{'0' * 32}\n", "/"]
)
def test_a_key_is_digits_or_no_part_of_a_path(key: str, tmp_path: Path) -> None:
    (tmp_path / "victim").mkdir()
    for use in used(Store(tmp_path / "store"), key):
        with pytest.raises(InvalidValueError, match="expected 32 hexadecimal digits"):
            use()
    assert [path.name for path in tmp_path.iterdir()] == ["victim"]


def test_a_plan_with_another_key_is_refused(tmp_path: Path) -> None:
    store = Store(tmp_path)
    note_keys(store, "numbers", ["0" * 32])
    (tmp_path / "plans" / "numbers.json").write_text('["../victim"]')
    with pytest.raises(
        InvalidValueError, match=r"expected 32 hexadecimal digits, got \.\./victim"
    ):
        planned(store, "numbers")


@pytest.mark.parametrize(
    "link", ["jobs", "jobs/00", f"jobs/00/{'0' * 32}", "tmp", "partial", "failed"]
)
def test_no_link_leads_out_of_a_store(link: str, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    path = tmp_path / "store" / link
    victim.mkdir()
    path.parent.mkdir(parents=True)
    path.symlink_to(victim)
    store = Store(tmp_path / "store")
    messages = []
    for use in used(store, "0" * 32)[2:]:
        try:
            use()
        except (InvalidValueError, SplatFileError) as error:
            messages.append(str(error))
    assert any(
        "expected a part of the store, got a symbolic link" in message
        for message in messages
    )
    assert not list(victim.iterdir())


def test_a_plan_replaces_a_link_and_not_what_it_leads_to(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "store" / "plans").mkdir(parents=True)
    (tmp_path / "store" / "plans" / "numbers.json").symlink_to("../../mine.txt")
    note_keys(Store(tmp_path / "store"), "numbers", ["0" * 32])
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("inputs", 7),
        ("inputs", {"a": 7}),
        ("rows", 7),
        ("rows", [7]),
        ("files", {"a": 7}),
        ("varies", 7),
        ("varies", [7]),
    ],
)
def test_a_record_of_other_kinds_of_values_is_refused(
    name: str, value: object, tmp_path: Path
) -> None:
    ledger = Ledger(tmp_path)
    done = ledger.do(Job(kind=NUMBERS, config=NumbersConfig()))
    path = ledger.store.folder_of(done.key) / "job.json"
    record = {**read_json(path), name: value}
    if name in ("rows", "files"):
        record["content"] = digest([record["files"], record["rows"]])
    path.write_text(json.dumps(record))
    with pytest.raises(InvalidValueError, match="expected the record of job"):
        ledger.store.record(done.key)


def test_what_another_process_found_is_kept_once(tmp_path: Path) -> None:
    store = Store(tmp_path)
    task = Task(
        kind=NUMBERS,
        config=NumbersConfig(),
        inputs={"a": {"content": "0" * 64}},
        code="c",
    )
    for text in ("first", "second"):
        store.keep(task, [{"claim": text}], {"result.json": {"text": text}})
    done = store.existing(task.key)
    assert done.rows == [{"claim": "first"}]
    assert read_json(done.folder / "result.json") == {"text": "first"}
    assert not [*(tmp_path / "tmp").iterdir()]
