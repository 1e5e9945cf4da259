"""Foreign folders of results and stores: whatever keys and links they hold, nothing outside of them changes."""

import contextlib
import json
import shutil
from pathlib import Path
from typing import Any

from mi_splat.errors import MiSplatError
from mi_splat.io.documents import save_text
from mi_splat.io.folders import new_folder, own_folder
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger import Job, Store
from mi_splat.ledger.plans import plan, planned
from tests.ledger.kinds.configs import NumbersConfig

JOBS = {name: Job(kind="tests.ledger.kinds.numbers", config=NumbersConfig(name=name)) for name in ("one", "two")}
LINKS = {"store/plans/numbers.json": "../../victim/f", "store/jobs": "../victim", "store/tmp": "../victim"}
LINKS |= {"out/.mi-splat.lock": "../victim/f", "out/images": "../victim", "out/result.json": "../victim/f"}


def plan_with_keys(folder: Path) -> Path:
    """A plan of a store, beside a folder that is none of its business."""
    plan(Store(folder / "store"), "numbers", JOBS)
    return folder / "store" / "plans" / "numbers.json"


def clean(path: Path) -> None:
    """Do with the keys of a plan what `study retry` and `study clean` do."""
    store, victim = Store(path.parents[1]), _victim(path.parents[2])
    try:
        for key in planned(store, "numbers"):
            store.forgive(key)
            store.remove(key)
    finally:
        _check(victim)


def write_among_links(path: Path) -> None:
    """Make the links that a file lists, and write into the folders that hold them."""
    links: dict[str, Any] = DocumentReader().read_json(path)
    folder = path.parent / "links"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    victim = _victim(folder)
    for name, target in links.items():
        link = folder / name
        if ".." not in Path(name).parts and link.is_relative_to(folder) and isinstance(target, str):
            with contextlib.suppress(OSError, ValueError):
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(target)
    try:
        for write in (_plan, _replace, _go_on):
            with contextlib.suppress(MiSplatError):
                write(folder)
    finally:
        _check(victim)


def _plan(folder: Path) -> None:
    store = Store(folder / "store")
    for entry in plan(store, "numbers", JOBS):
        store.remove(entry.key)
        with store.making(entry.key) as (temporary, partial):
            partial.mkdir(parents=True)
            (temporary / "files" / "f").write_text("new")


def _replace(folder: Path) -> None:
    with new_folder(folder / "out", force=True) as made:
        (made / "result.json").write_text("{}")


def _go_on(folder: Path) -> None:
    with own_folder(folder / "out", "result.json"):
        (folder / "out" / "images").mkdir(exist_ok=True)
        for name in ("result.json", "images/f"):
            save_text("new", folder / "out" / name)


def _victim(folder: Path) -> Path:
    victim = folder / "victim"
    victim.mkdir(exist_ok=True)
    (victim / "f").write_text("precious")
    return victim


def _check(victim: Path) -> None:
    if [path.name for path in victim.iterdir()] != ["f"] or (victim / "f").read_text() != "precious":
        raise AssertionError("something outside of the folder has changed")


def links(folder: Path) -> Path:
    """A file that lists links."""
    (folder / "links.json").write_text(json.dumps(LINKS))
    return folder / "links.json"
