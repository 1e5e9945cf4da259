"""Results, records, documents that are written by hand, and what `conform` reads."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from attacks.bench.suite import SUITES, read_suite
from attacks.cli import gate
from attacks.figures.result import read_result
from attacks.observe.rows import frame_of, packed, read_rows, rows, rows_bytes
from attacks.report.checking import check_result
from attacks.report.results import RESULT_KINDS, kind_of, read_section
from attacks.report.viewer_content import open_content, recorded_up
from attacks.studies import study_file
from mi_splat.capture.record import claim_folder
from mi_splat.cli import conform
from mi_splat.cli.bound import read_certificate
from mi_splat.conformance.files import read_gradients, read_images
from mi_splat.errors import MiSplatError
from mi_splat.io.documents import save_json
from mi_splat.io.folders import locked_folder, write_manifest
from mi_splat.ledger.states import note_keys, planned
from mi_splat.ledger.store import Store
from mi_splat.render.renderer import save_floats
from tests.campaign.kind import Kind, copied, written
from tests.campaign.mutations import (
    PLAIN_JSON,
    XZ,
)
from tests.campaign.of_splats import picture
from tests.ledger.drive import Ledger, walk
from tests.project.layers import ROOT
from tests.report.results import MAKERS

# Results


def _rows(name: str, folder: Path) -> Path:
    more = {
        f"depth: {number}": 1.0
        for number in range(190 if name.startswith("wide") else 0)
    }
    values: Iterator[dict[str, str | float]] = (
        {"view": view, "splat": "clean", "iou": 0.5 / (view + 1), **more}
        for view in range(20)
    )
    data = rows_bytes(frame_of(values))
    (folder / name).write_bytes(packed(data) if name.endswith(".xz") else data)
    return folder / name


def _result(name: str, folder: Path) -> Path:
    return MAKERS[name](folder / "result") / "result.json"


def _read_result(path: Path) -> None:
    """As `report` and `view` read a result; what cannot be viewed is refused in
    words.
    """
    read_section(path.parent)
    recorded_up(path.parent)
    with contextlib.suppress(MiSplatError):
        open_content(path.parent)


def _artifact(file: str, folder: Path) -> Path:
    shutil.copytree(ROOT / "docs/artifacts/transfer_views", folder / "artifact")
    return next((folder / "artifact").glob(file))


def _small_result(file: str, folder: Path) -> Path:
    """A result whose manifest lists what is there."""
    made = MAKERS["dagger"](folder / "result")
    write_manifest(made)
    return made / file


def _check(path: Path) -> None:
    result = read_result(path.parent)
    check_result(result, kind_of(result).derive)


_CAPTURE = {
    "version": "1",
    "scene": "a",
    "cameras": "b",
    "train": 3,
    "test": 1,
    "samples": 16,
    "seed": 0,
}
_CAPTURE |= {"alpha": True, "points": 0, "near": None, "pictures": 1, "mitsuba": "3"}
_CAPTURE |= {"inputs": {"scene": {"object": "car"}, "cameras": {"count": 3}}}


def _job(folder: Path) -> Path:
    done = Ledger(folder / "store").do(walk(3))
    return done.folder.parent / "job.json"


def _read_job(path: Path) -> None:
    store = Store(path.parents[3])
    key = path.parent.name
    store.keys()
    store.record(key)
    store.done(key)


def _plan(folder: Path) -> Path:
    store = Store(folder / "store")
    note_keys(store, "walks", ["0" * 32, "1" * 32])
    return folder / "store" / "plans" / "walks.json"


def _forget(path: Path) -> None:
    """Do with the keys of a plan what `study retry` and `study clean` do."""
    store = Store(path.parents[1])
    for key in planned(store, "walks"):
        store.forgive(key)
        store.remove(key)


_HOLDER = {
    "host": "elsewhere",
    "process": 7,
    "command": "mi-splat train",
    "since": "2026-01-01 00:00:00",
}


def _lock(folder: Path) -> Path:
    (folder / "out").mkdir()
    save_json(_HOLDER, folder / "out" / ".mi-splat.lock")
    return folder / "out" / ".mi-splat.lock"


def _take(path: Path) -> None:
    content = path.read_bytes()
    try:
        with locked_folder(path.parent):
            pass
    finally:
        path.write_bytes(content)


def results() -> Iterator[Kind]:
    for name in ("rows.csv", "rows.csv.xz", "wide.csv.xz"):
        yield Kind(
            name=f"rows {name}",
            make=partial(_rows, name),
            read=read_rows,
            readers=("attacks.observe.rows:read_rows",),
            packing=XZ if name.endswith(".xz") else None,
        )
    for kind in RESULT_KINDS:
        yield Kind(
            name=f"result {kind.name}",
            make=partial(_result, kind.name),
            read=_read_result,
            readers=(
                f"attacks.report.kinds.{kind.reader}",
                "attacks.report.results:read_section",
                "attacks.report.viewer_content:recorded_up",
                "mi_splat.io.parsing:read_json",
                "attacks.report.viewer_content:open_content",
            ),
            document=PLAIN_JSON,
        )
    checks = (
        "attacks.figures.result:read_result",
        "mi_splat.io.folders:read_manifest",
    )
    for name in ("result.json", "manifest.json"):
        make = partial(_small_result, name)
        yield Kind(
            name=f"checked {name}",
            make=make,
            read=_check,
            readers=checks,
            document=PLAIN_JSON,
        )
    yield Kind(
        name="checked table",
        make=partial(_artifact, "rows.csv.xz"),
        read=_check,
        readers=(*checks, "attacks.figures.result:read_tables"),
        packing=XZ,
    )
    yield Kind(
        name="checked figures",
        make=partial(_artifact, "figures.csv"),
        read=_check,
        readers=(*checks, "attacks.figures.frame:read_figures"),
    )
    yield Kind(
        name="record of a capture",
        make=written("capture.json", lambda: _CAPTURE),
        read=_claim,
        readers=("mi_splat.capture.record",),
        document=PLAIN_JSON,
    )
    yield Kind(
        name="job.json",
        make=_job,
        read=_read_job,
        readers=("mi_splat.ledger.store",),
        document=PLAIN_JSON,
    )
    yield Kind(
        name="plan",
        make=_plan,
        read=_forget,
        readers=("mi_splat.ledger.states",),
        document=PLAIN_JSON,
    )
    yield Kind(
        name="lock",
        make=_lock,
        read=_take,
        readers=("mi_splat.io.folders",),
        document=PLAIN_JSON,
    )
    rows_of = ("attacks.observe.rows:rows",)
    table = partial(_small_result, "rows.csv.xz")
    yield Kind(
        name="rows of a result",
        make=table,
        read=lambda p: rows(p.parent),
        readers=rows_of,
        packing=XZ,
    )


def _claim(path: Path) -> None:
    folder = path.parent / "of a capture"
    folder.mkdir()
    try:
        shutil.copy(path, folder / "capture.json")
        claim_folder(folder, _CAPTURE)
    finally:
        shutil.rmtree(folder)


# Documents that are written by hand


_CERTIFICATE = {"eps": 0.05, "beyond": 0, "scene_hash": "0" * 64}
_POLICY = (
    b'seconds = 5\nmegabytes = 900\nclaims = ["readable", "numbers"]\n[rules]\nerror ='
    b' "refuse"\ndiffers = "accept"\n'
)
_LINES = b'"a.ply"\n{"file": "b.ply", "against": "a.ply"}\n"\\u00e9.spz"\nnot JSON\n'


def _read_policy(path: Path) -> None:
    gate._policy(gate.GateOptions(policy=path))


def _read_lines(path: Path) -> None:
    before = sys.stdin
    with path.open("rb") as file:
        sys.stdin = io.TextIOWrapper(file)
        try:
            requests = list(gate._requests(()))
        finally:
            sys.stdin = before
    for request in requests:
        json.dumps(request)


@contextlib.contextmanager
def _in_folder(folder: Path) -> Iterator[None]:
    """Another working folder inside the block."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def _suite(name: str, folder: Path) -> Path:
    shutil.copytree(next((ROOT / SUITES).iterdir()), folder / "suite")
    return folder / "suite" / name


def _read_suite(path: Path) -> None:
    with _in_folder(ROOT):
        read_suite(str(path.parent))


def _read_plan(path: Path) -> None:
    """Everything that a study file says, down to the settings of each of its points."""
    from attacks.studies.running import work_of

    with _in_folder(ROOT):
        work_of(study_file.read_study(path))


STUDIES = (
    *(
        "cloak_demo",
        "studies/cloak_elsewhere",
        "studies/attack_zoo",
        "studies/eot_smallest",
    ),
    *("studies/renderers_trained", "studies/poison_demo"),
)
"""Of every kind of study one that needs no detector of others."""


def documents() -> Iterator[Kind]:
    study = ("attacks.studies.study_file:read_study",)
    for name in STUDIES:
        make = copied(f"scenes/{name}.toml")
        yield Kind(
            name=f"study {Path(name).name}.toml",
            make=make,
            read=_read_plan,
            readers=study,
        )
    suite = ("attacks.bench.suite:read_suite",)
    yield Kind(
        name="suite",
        make=partial(_suite, "suite.toml"),
        read=_read_suite,
        readers=suite,
    )
    policy = written("policy.toml", lambda: _POLICY)
    yield Kind(
        name="policy", make=policy, read=_read_policy, readers=("attacks.cli.gate",)
    )
    certificate = written("splat.ply.bound.json", lambda: _CERTIFICATE)
    yield Kind(
        name="certificate",
        make=certificate,
        read=read_certificate,
        readers=("mi_splat.cli.bound:read_certificate",),
        document=PLAIN_JSON,
    )
    lines = written("lines", lambda: _LINES)
    yield Kind(
        name="lines of the gate",
        make=lines,
        read=_read_lines,
        readers=("attacks.cli.gate",),
    )


# What `conform` reads


def _exr(folder: Path) -> Path:
    values = np.linspace(0, 1, 12 * 9, dtype=np.float32).reshape(9, 12)
    path = folder / f"{_SCENE}.exr"
    save_floats({"R": values, "G": values, "B": values}, path)
    return path


_SCENE = "quaternion"


def _read_images(path: Path, readers: Mapping[str, Any] | None = None) -> None:
    found = read_images(path.parent, [_SCENE], readers)
    assert found[_SCENE].values.ndim == 3


_EXACT = {"means": np.ones((4, 3)), "opacities": np.ones(4)}


def _npz(folder: Path) -> Path:
    np.savez_compressed(
        folder / "g.npz", means=_EXACT["means"], opacities=_EXACT["opacities"]
    )
    return folder / "g.npz"


def _png(folder: Path) -> Path:
    return picture(f"{_SCENE}.png", folder)


def _npy(folder: Path) -> Path:
    np.save(folder / f"{_SCENE}.npy", np.linspace(0, 1, 6 * 5 * 3).reshape(6, 5, 3))
    return folder / f"{_SCENE}.npy"


def conform_inputs() -> Iterator[Kind]:
    files = "mi_splat.conformance.files"
    floats = ("mi_splat.render.renderer:load_floats", "mi_splat.cli.conform")
    yield Kind(
        name="conform EXR",
        make=_exr,
        read=partial(_read_images, readers={".exr": conform._read_exr}),
        readers=floats,
    )
    yield Kind(
        name="conform PNG",
        make=_png,
        read=partial(_read_images, readers={".png": conform._read_picture}),
        readers=("mi_splat.cli.conform",),
    )
    yield Kind(
        name="conform PNG by NumPy",
        make=_png,
        read=_read_images,
        readers=(f"{files}:read_images", f"{files}:read_png"),
    )
    yield Kind(
        name="conform NPY",
        make=_npy,
        read=_read_images,
        readers=(f"{files}:read_npy",),
    )
    yield Kind(
        name="conform NPZ",
        make=_npz,
        read=lambda path: read_gradients(path.parent, {path.stem: _EXACT}),
        readers=(f"{files}:read_gradients",),
    )
