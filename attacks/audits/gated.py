"""What the gate finds in a splat file, claim by claim: the process that reads the file.

`python -m attacks.audits.gated DESCRIPTOR` answers requests that come through a pipe
(see `attacks.audits.judging`), one JSON object each: first the SHA-256 of the files,
then, if it is told to go on, findings as they are found. Nothing else reads what
strangers send, and whatever reads it here shares the limits of this process. It writes
into its temporary folder alone.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from attacks.audits.recognition import Recognition
from attacks.classifiers.prototypes import has_features
from mi_splat.audit.against import changes
from mi_splat.audit.auditing import audit
from mi_splat.audit.bound import colour_bound
from mi_splat.audit.files import document
from mi_splat.audit.gate import FILE, Claim, GateConfig, Row, fingerprint, sampled
from mi_splat.audit.image_files import image_names, summary_of
from mi_splat.audit.images import audit_images
from mi_splat.audit.linting import Lint, lint_file
from mi_splat.audit.sarif import findings
from mi_splat.datasets import is_dataset, load_dataset
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.fields import decode
from mi_splat.io.errors import SplatFileError, from_os_error
from mi_splat.io.splat_files import load_stored
from mi_splat.process_group import connection, inbox, limit_file_size
from mi_splat.processes import keep_to
from mi_splat.render.scene_files import open_scene
from mi_splat.scene import GaussianScene

_CLAIM_OF: Mapping[str, Claim] = {
    "contradicted": "hidden appearance",
    "differs": "hidden appearance",
    "overdraw": "cost",
}
"""The claim that a rule is about; rules of glTF are about what is readable, all others
about the numbers.
"""
_MADE_UP = ("/proc", "/sys")
"""Folders whose files are no files of a disk: their sizes mean nothing, and reading
them may never end.
"""
_PART = 1 << 20
_MOST_FILES = 20_000
"""Bytes that are hashed at once; files that a set of images may have."""

Message = dict[str, Any]
Say = Callable[[Message], None]
_State = tuple[int, int, int, int, int]


def answer(request: Mapping[str, Any], say: Say, goes_on: Callable[[], bool]) -> None:
    """Answer one request: the contents of its files, then, if the judge has not seen
    them before, what is found.

    Args:
        request: `files` by their roles (`splat`, and `clean` where an older copy is
            known), `config`, and `file_megabytes`.
        say: Sends a message to the judge.
        goes_on: Receives whether the contents are to be judged.
    """
    config = decode(GateConfig, request["config"], "config")
    hidden: list[str] = []
    with TemporaryDirectory() as folder:
        try:
            links = {
                role: _link(Path(folder), role, name, config)
                for role, name in request["files"].items()
            }
            hidden += [str(link) for link in links.values()] + [
                os.path.realpath(link) for link in links.values()
            ]
            most = request["file_megabytes"] * 1e6
            read = {role: _read(link, most) for role, link in links.items()}
            say(
                {
                    "state": "read",
                    "contents": {role: content for role, (content, _) in read.items()},
                    "features": has_features(),
                }
            )
            if not goes_on():
                return
            for message in _found_in(config, links):
                say(_without(hidden, message))
            for role, link in links.items():
                if _now(link) != read[role][1]:
                    raise _changed(link)
            end: Message = {"state": "done"}
        except (MiSplatError, OSError, ValueError, MemoryError) as error:
            end = {
                "state": "failed",
                "error": " ".join(str(error).split()) or type(error).__name__,
            }
        say(_without(hidden, end))


def _link(folder: Path, role: str, name: str, config: GateConfig) -> Path:
    """A name for a file that says nothing but its format; nothing lies beside it that
    it could refer to.
    """
    link = folder / f"{role}{config.ending}"
    link.symlink_to(os.path.abspath(name))
    return link


def _without(hidden: Iterable[str], value: Any) -> Any:
    """A message without the names of the files that it is about."""
    if isinstance(value, str):
        for name in hidden:
            value = value.replace(name, FILE)
        return value
    if isinstance(value, Mapping):
        return {key: _without(hidden, item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without(hidden, item) for item in value]
    return value


def _read(path: Path, most: float) -> tuple[str, _State]:
    """SHA-256 of a regular file of a disk, or of all those of a set of images, and the
    state in which it was read.
    """
    if path.is_dir() and is_dataset(path):
        return _read_set(path, most)
    try:
        target = os.path.realpath(path, strict=True)
        if not stat.S_ISREG(os.stat(target).st_mode) or target.startswith(
            tuple(f"{name}/" for name in _MADE_UP)
        ):
            expected = "a regular file on a disk"
            got = "a folder, a device, a pipe or a file of the system"
            raise InvalidValueError.of(
                str(path), expected, got, "pass the path of a splat file"
            )
        # Without O_NONBLOCK, opening a pipe that was put there meanwhile would wait for
        # ever.
        descriptor = os.open(target, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise from_os_error(str(path), "a file that can be read", error) from error
    with open(descriptor, "rb", buffering=0) as file:
        status = os.fstat(descriptor)
        if status.st_size > most:
            expected = f"a file of at most {most / 1e6:,.0f} MB"
            got = f"{status.st_size / 1e6:,.0f} MB"
            raise InvalidValueError.of(
                str(path),
                expected,
                got,
                "raise file_megabytes in --policy if you trust it",
            )
        total = hashlib.sha256()
        size = 0
        while size <= status.st_size and (part := file.read(_PART)):
            total.update(part)
            size += len(part)
    if size != status.st_size:
        raise _changed(path)
    return total.hexdigest(), _state(status)


def _read_set(path: Path, most: float) -> tuple[str, _State]:
    """The SHA-256 of the names and contents of all files of a set, and its size; links
    are not followed.
    """
    folder = os.path.realpath(path)
    total = hashlib.sha256()
    size = 0
    count = 0
    for place, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            file = Path(place, name)
            count += 1
            size += os.lstat(file).st_size
            if size > most or count > _MOST_FILES:
                expected = f"a set of at most {most / 1e6:,.0f} MB and {_MOST_FILES:,}"
                got = f"{size / 1e6:,.0f} MB in {count:,} files or more"
                do = "raise file_megabytes in --policy if you trust it"
                raise InvalidValueError.of(str(path), f"{expected} files", got, do)
            if os.path.islink(file):
                do = "put the file itself there"
                raise InvalidValueError.of(str(path), "no links", file.name, do)
            content, _ = _read(file, most)
            total.update(f"{file.relative_to(folder).as_posix()}\0{content}".encode())
    return total.hexdigest(), (0, 0, size, count, 0)


def _now(path: Path) -> _State:
    """The state of what was read as it is now; a set is known by the numbers and sizes
    of its files.
    """
    if not path.is_dir():
        return _state(os.stat(path))
    sizes = [
        os.lstat(Path(place, name)).st_size
        for place, _, names in os.walk(os.path.realpath(path))
        for name in names
    ]
    return (0, 0, sum(sizes), len(sizes), 0)


def _state(status: os.stat_result) -> _State:
    return (
        status.st_dev,
        status.st_ino,
        status.st_size,
        status.st_mtime_ns,
        status.st_ctime_ns,
    )


def _changed(path: Path) -> InvalidValueError:
    do = "judge it again once it is written"
    return InvalidValueError.of(
        str(path), "a file that stays the same", "one that changes while it is read", do
    )


def _found_in(config: GateConfig, inputs: Mapping[str, Path]) -> Iterator[Message]:
    """Findings in messages, and the account of the audit."""
    for found in _rows(config, inputs):
        if "claim" not in found:
            yield {"state": "account", "account": found}
            continue
        row = {
            "claim": "",
            "rule": "",
            "severity": "",
            "reason": "",
            "judged": True,
            **found,
        }
        yield {"state": "row", "row": row}


def _rows(config: GateConfig, inputs: Mapping[str, Path]) -> Iterator[Row]:
    """Findings of one claim after the other, each ended by a row without a rule; and an
    account, without a claim.
    """
    path = inputs["splat"]
    if path.is_dir():
        yield from _set_rows(path)
        return
    stored = None
    unread = ""
    try:
        stored = load_stored(path)
    except SplatFileError as error:
        unread = str(error)
    try:
        lint = lint_file(path, stored)
    except SplatFileError as error:
        yield {
            "claim": "readable",
            "rule": "unreadable",
            "severity": "error",
            "reason": unread or str(error),
        }
        yield {"claim": "readable"}
        return
    account = document(None, lint)
    yield from _found(account, ())
    if stored is not None:
        known = {"fingerprint": fingerprint(stored.arrays), "gaussians": lint.gaussians}
    else:
        known = {}
    yield {"claim": "readable", **known}
    if stored is None:
        return
    yield from ({"claim": claim} for claim in ("numbers", "cost"))
    yield from _appearances(config, stored.scene, lint, account)
    if config.bounded is not None:
        yield from _beyond(stored.scene, config.bounded)
    if "clean" in inputs:
        yield from _provenance(stored.scene, inputs["clean"])


def _set_rows(path: Path) -> Iterator[Row]:
    """What is found in a set of images."""
    folder = path.resolve()
    try:
        views = load_dataset(path, split=None)
        for file in views.paths:
            if not file.resolve().is_relative_to(folder):
                do = "put all images into the folder"
                raise InvalidValueError.of(
                    str(path), "images in the set", "one elsewhere", do
                )
    except MiSplatError as error:
        reason = " ".join(str(error).split())
        unread = {"rule": "unreadable", "severity": "error", "reason": reason}
        yield {"claim": "readable", **unread}
        yield {"claim": "readable"}
        return
    yield {"claim": "readable"}
    # claims about splats
    yield from ({"claim": claim} for claim in ("numbers", "cost"))
    try:
        judged = audit_images(views)
    except MiSplatError as error:
        reason = " ".join(str(error).split())
        yield {"claim": "hidden appearance", "judged": False, "reason": reason}
        return
    reason = "; ".join(summary_of(judged, image_names(views)))
    if judged.verdict == "not judged":
        yield {"claim": "hidden appearance", "judged": False, "reason": reason}
        return
    if judged.verdict == "two groups":
        found = {"rule": "two-groups", "severity": "warning", "reason": reason}
        yield {"claim": "hidden appearance", **found}
    yield {"claim": "hidden appearance"}


def _beyond(scene: GaussianScene, eps: float) -> Iterator[Row]:
    """Whether colours depart further than a policy allows."""
    beyond = int((colour_bound(scene) > eps).sum())
    if beyond:
        reason = (
            f"The colours of {beyond:,} Gaussians may depart by more than {eps:g} in"
            " some direction; `mi-splat bound` writes a copy that does not."
        )
        yield {
            "claim": "hidden appearance",
            "rule": "unbounded",
            "severity": "warning",
            "reason": reason,
        }


def _found(document: Mapping[str, Any], known: Iterable[str]) -> Iterator[Row]:
    """The findings of an account."""
    for name, severity, reason, _ in findings(document):
        rule = name.removeprefix("lint/")
        if rule.startswith("gltf-"):
            claim = "readable"
        else:
            claim = _CLAIM_OF.get(rule, "numbers")
        if claim not in known:
            yield {"claim": claim, "rule": rule, "severity": severity, "reason": reason}


def _appearances(
    config: GateConfig, scene: GaussianScene, lint: Lint, account: dict[str, Any]
) -> Iterator[Row]:
    """What the audit finds in a splat that can be rendered."""
    unjudged = ""
    judged = None
    errors = [item.rule for item in lint.findings if item.severity == "error"]
    if errors:
        unjudged = f"the file has errors: {', '.join(errors)}"
    elif "hidden appearance" in config.claims:
        try:
            judged = audit(sampled(scene, config.most_gaussians), Recognition())
        except MiSplatError as error:
            unjudged = " ".join(str(error).split())
    if judged or unjudged:
        account = document(judged, lint, unjudged=unjudged)
    yield account
    if judged is not None and not judged.views:
        unjudged = judged.summary()[0]
    if judged is None or unjudged:
        yield {"claim": "hidden appearance", "judged": False, "reason": unjudged}
        return
    yield from _found(account, ("readable", "numbers", "cost"))
    yield {"claim": "hidden appearance"}


def _provenance(scene: GaussianScene, clean: Path) -> Iterator[Row]:
    """What changed since the file that is known to be clean."""
    try:
        changed = changes(scene, open_scene(clean).scene)
    except MiSplatError as error:
        yield {
            "claim": "provenance",
            "judged": False,
            "reason": " ".join(str(error).split()),
        }
        return
    if bool(changed.changed.any()) or changed.removed:
        reason = "; ".join(changed.in_words())
        yield {
            "claim": "provenance",
            "rule": "changed",
            "severity": "warning",
            "reason": reason,
        }
    yield {"claim": "provenance"}


def main() -> int:
    """Answer requests until nobody watches any more."""
    cores, megabytes, descriptor = sys.argv[1:]
    pipe = connection(descriptor)
    messages = inbox(pipe.recv_bytes)
    keep_to([int(core) for core in cores.split(",") if core])
    limit_file_size(float(megabytes))
    # where memory runs out, the system ends this process first
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")

    def say(message: Message) -> None:
        pipe.send_bytes(json.dumps(message).encode())

    def hear() -> Any:
        return json.loads(messages.get())

    say({"state": "ready"})
    while True:
        answer(hear(), say, hear)


if __name__ == "__main__":
    sys.exit(main())
