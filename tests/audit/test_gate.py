"""`mi-splat gate`: a verdict on every claim and every file, whatever a file does, and
what says which splat it is.
"""

import contextlib
import io
import json
import os
import queue
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from attacks import cli
from attacks.audits import gated
from attacks.audits.gated import answer
from attacks.audits.judging import Message
from attacks.cli import gate
from mi_splat.audit import bounded, linting
from mi_splat.audit.gate import CLAIMS, Policy, fingerprint, sampled
from mi_splat.audit.image_splits import Split
from mi_splat.audit.images import ImageAudit
from mi_splat.io import save_splat
from mi_splat.io.splat_files import load_stored
from mi_splat.ledger import Store
from mi_splat.process_group import GroupEndedError
from tests.audit.recogniser import Painted, judged, painted
from tests.audit.scenes import cone, direction, hidden, standing
from tests.audit.test_lint import broken_ply, cloud, masked
from tests.datasets.sets import VIEWS, write_transforms


@pytest.fixture(autouse=True, scope="module")
def _few_small_pictures() -> object:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(linting, "SIZE", 256)
        yield


def row(claim: str, rule: str = "", severity: str = "", **more: Any) -> dict[str, Any]:
    return {
        "claim": claim,
        "rule": rule,
        "severity": severity,
        "reason": rule and "why",
        "judged": True,
        **more,
    }


SCENES = Path(__file__).parents[2] / "scenes"
PASSED = [row(claim) for claim in CLAIMS[:-1]]


@pytest.mark.parametrize(
    ("rules", "found", "verdict"),
    [
        ({}, row("numbers", "giant", "warning"), "accept"),
        ({"giant": "refuse"}, row("numbers", "giant", "warning"), "refuse"),
        ({"warning": "quarantine"}, row("numbers", "giant", "warning"), "quarantine"),
        ({"error": "quarantine"}, row("cost", "overdraw", "error"), "quarantine"),
        ({}, row("hidden appearance", "contradicted", "error"), "refuse"),
        ({}, row("hidden appearance", "differs", "note"), "accept"),
        ({}, row("hidden appearance", judged=False, reason="why"), "not judged"),
    ],
)
def test_a_policy_says_what_follows_from_a_finding(
    rules: Any, found: dict[str, Any], verdict: str
) -> None:
    rest = [one for one in PASSED if one["claim"] != found["claim"] or found["rule"]]
    told = Policy(rules=rules).verdict([*rest, found])
    assert told["verdict"] == told["claims"][found["claim"]]["verdict"] == verdict


def test_what_was_not_judged_is_no_pass() -> None:
    assert Policy().verdict(PASSED)["verdict"] == "accept"
    told = Policy().verdict(PASSED[:3])
    assert (
        told["verdict"]
        == told["claims"]["hidden appearance"]["verdict"]
        == "not judged"
    )
    assert Policy(claims=CLAIMS[:3]).verdict(PASSED[:3])["verdict"] == "accept"
    told = Policy().verdict([])
    assert told["verdict"] == "not judged"
    line = gate._in_words({"file": "b.ply: accept\na.ply", "error": None, **told})
    assert line == "b.ply: accept\\na.ply: not judged"


def alike(first: str, second: str) -> bool:
    """Whether each moment is within the step that a format's rounding may cost."""
    return all(
        abs(a - b) <= 1
        for a, b in zip(bytes.fromhex(first), bytes.fromhex(second), strict=True)
    )


@pytest.mark.parametrize(
    "suffix", [".ply", ".spz", ".sog", ".splat", ".compressed.ply", ".glb"]
)
def test_a_fingerprint_is_that_of_the_splat_in_any_order_and_format(
    suffix: str, tmp_path: Path
) -> None:
    scene = standing("car", count=900).scene
    path = tmp_path / f"s{suffix}"
    save_splat(scene, tmp_path / "s.ply")
    save_splat(
        scene.select(
            torch.randperm(len(scene), generator=torch.Generator().manual_seed(3))
        ),
        path,
    )
    first, again = (
        fingerprint(load_stored(file).arrays) for file in (tmp_path / "s.ply", path)
    )
    assert first == again if suffix == ".ply" else alike(first, again)
    save_splat(standing("tv", count=900).scene, path)
    assert not alike(first, fingerprint(load_stored(path).arrays))


def test_a_fingerprint_leaves_out_what_is_no_number(tmp_path: Path) -> None:
    arrays = load_stored(broken_ply(tmp_path / "s.ply")).arrays
    rest = {name: np.delete(value, [7], 0) for name, value in arrays.items()}
    assert fingerprint(arrays) == fingerprint(rest) != ""
    assert fingerprint({name: value[7:8] for name, value in arrays.items()}) == ""


def test_an_appearance_is_found_in_a_sample() -> None:
    made = painted("suitcase", count=3000)
    scene = hidden(made, cone(direction(90, 0), 50)).scene
    part = sampled(scene, 2000)
    assert len(part) == 2000
    assert judged(part).answer == "contradicted"
    assert judged(sampled(made.scene, 2000)).answer != "contradicted"
    assert sampled(scene, len(scene)) is scene


class InThread:
    """Reads in a thread of the tests, and loses its process over a file with a hostile
    name.
    """

    def __init__(self) -> None:
        self._said: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._heard: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._is_lost = False

    def ask(self, request: Mapping[str, Any]) -> None:
        self._is_lost = "hostile" in request["files"]["splat"]
        words = (request, self._said.put, self._heard.get)
        threading.Thread(target=answer, args=words, daemon=True).start()

    def go_on(self, is_new: bool) -> None:
        self._heard.put(is_new)

    def answer(self) -> Message:
        message = self._said.get(timeout=60)
        # what costs time comes next
        if self._is_lost and message["state"] == "account":
            raise GroupEndedError("ended by SIGKILL")
        return message

    def end(self, *, for_good: bool) -> None:
        if for_good:
            self.__init__()  # type: ignore[misc]

    def close(self) -> None:
        pass


@contextlib.contextmanager
def _readers_in_threads(
    workers: int, policy: Policy, store: Store
) -> Iterator[list[Any]]:
    yield [InThread()]


def run(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    lines: list[Any],
    *words: str,
) -> tuple[int, dict[str, dict[str, Any]]]:
    """Exit status, and the verdict on each file that standard input names."""
    monkeypatch.setattr(gate, "_readers", _readers_in_threads)
    given = io.TextIOWrapper(
        io.BytesIO(
            b"read before\n"
            + b"left\n" * (not lines)
            + "".join(f"{line}\n" for line in lines).encode()
        )
    )
    # text that was read before is read for good
    given.buffer.readline() if lines else given.readline()
    monkeypatch.setattr("sys.stdin", given)
    status = cli.main(
        ["gate", "--json", "--strict", "--store", str(tmp_path / "store"), *words]
    )
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(told) == (
        len(lines) or len([word for word in words if word.endswith(".ply")])
    )
    return status, {Path(one["file"]).name: one for one in told}


def test_honest_trained_files_pass_and_need_no_standard_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {
        f"--policy={name}.ply": SCENES / f"{name}.ply"
        for name in ("car_street_car", "stop_sign_stop_sign")
    }
    for name, file in files.items():  # names of files that are no options
        (tmp_path / name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    status, told = run(capsys, monkeypatch, tmp_path, [], "--", *files)
    assert status == 0
    assert {name: one["verdict"] for name, one in told.items()} == dict.fromkeys(
        files, "accept"
    )


def test_every_line_has_a_verdict_and_a_hostile_file_takes_none_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save_splat(cloud(), tmp_path / "fine.ply")
    save_splat(cloud(seed=1), tmp_path / "hostile.ply")
    save_splat(masked(), tmp_path / "heavy.ply")
    broken_ply(tmp_path / "broken.ply")
    (tmp_path / "text.ply").write_text("no splat")
    os.mkfifo(tmp_path / "pipe.ply")
    names = ["hostile", "broken", "text", "heavy", "pipe", "none", "fine"]
    lines = [json.dumps(str(tmp_path / f"{name}.ply")) for name in names]
    sarif = tmp_path / "s.sarif"
    status, told = run(
        capsys,
        monkeypatch,
        tmp_path,
        [*lines, "{}"],
        "--only",
        "lint",
        "--sarif",
        str(sarif),
    )
    expected = {
        **{
            "hostile.ply": "not judged",
            "broken.ply": "refuse",
            "text.ply": "refuse",
            "heavy.ply": "refuse",
        },
        **{
            "pipe.ply": "not judged",
            "none.ply": "not judged",
            "fine.ply": "accept",
            "{}": "not judged",
        },
    }
    assert status == 3
    assert {name: one["verdict"] for name, one in told.items()} == expected
    assert told["hostile.ply"]["error"] == "ended by SIGKILL"
    assert told["broken.ply"]["claims"]["numbers"]["reasons"][0]["rule"] == "not-finite"
    (log,) = json.loads(sarif.read_text())["runs"]
    assert "lint/not-finite" in {result["ruleId"] for result in log["results"]}
    assert len(log["artifacts"]) == len(expected)
    status, told = run(capsys, monkeypatch, tmp_path, [lines[0], lines[-1]])
    assert status == 1  # the process was lost before it looked for appearances
    assert told["hostile.ply"]["verdict"] == "not judged"
    assert told["hostile.ply"]["claims"]["numbers"]["verdict"] == "accept"


def test_appearances_and_provenance_are_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gated, "Recognition", Painted)
    made = painted("car", count=1500)
    save_splat(made.scene, tmp_path / "clean.ply")
    save_splat(hidden(made, cone(direction(90, 0), 50)).scene, tmp_path / "hidden.ply")
    clean = str(tmp_path / "clean.ply")
    lines = [
        {"file": clean, "against": clean},
        {"file": str(tmp_path / "hidden.ply"), "against": clean},
    ]
    (tmp_path / "policy.toml").write_text('[rules]\ncontradicted = "quarantine"\n')
    words = ["--policy", str(tmp_path / "policy.toml")]
    for verdict, more in (("quarantine", words), ("refuse", [])):
        status, told = run(
            capsys, monkeypatch, tmp_path, list(map(json.dumps, lines)), *more
        )
        assert status == (3 if verdict == "refuse" else 0)
        assert (
            told["clean.ply"]["verdict"]
            == told["clean.ply"]["claims"]["provenance"]["verdict"]
            == "accept"
        )
        assert (
            told["hidden.ply"]["claims"]["hidden appearance"]["verdict"]
            == told["hidden.ply"]["verdict"]
            == verdict
        )
        assert told["hidden.ply"]["claims"]["provenance"]["verdict"] == "quarantine"


def test_images_of_a_set_are_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    split = Split(
        smaller=torch.arange(6) < 2,
        decided=torch.ones(6, dtype=torch.bool),
        scores=torch.linspace(1, -1, 6),
        step=0.9,
        spread=0.1,
        gain=0.1,
        edge=3.0,
        difference=0.1,
        pair=(0, 5),
    )
    judged = ImageAudit(count=6, points=100, split=split)
    for name in ("few", "poisoned", "outside", "linked"):
        write_transforms(tmp_path / name, VIEWS)
    listing = tmp_path / "outside" / "transforms_train.json"
    listing.write_text(listing.read_text().replace("images/", "../few/images/"))
    (tmp_path / "linked" / "link").symlink_to("/etc/hostname")
    lines = [json.dumps(str(tmp_path / "few"))]
    status, told = run(capsys, monkeypatch, tmp_path, lines)
    assert status == 1
    (reason,) = told["few"]["claims"]["hidden appearance"]["reasons"]
    assert "images: expected at least 12, got 6" in reason["reason"]
    monkeypatch.setattr("attacks.audits.gated.audit_images", lambda views: judged)
    lines = [
        json.dumps(str(tmp_path / name)) for name in ("poisoned", "linked", "outside")
    ]
    image = next((tmp_path / "poisoned").rglob("*.png"))
    image.write_bytes(image.read_bytes() + b"0")  # another content than few
    status, told = run(capsys, monkeypatch, tmp_path, lines)
    assert status == 3
    assert told["poisoned"]["verdict"] == "quarantine"
    (reason,) = told["poisoned"]["claims"]["hidden appearance"]["reasons"]
    assert reason["rule"] == "two-groups"
    assert "expected no links" in told["linked"]["error"]
    assert told["outside"]["verdict"] == "refuse"
    (reason,) = told["outside"]["claims"]["readable"]["reasons"]
    assert "expected images in the set" in reason["reason"]


def test_a_policy_bounds_how_far_colours_depart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = standing("suitcase", count=600)
    looks = hidden(made, cone(direction(90, 0), 50)).scene
    save_splat(looks, tmp_path / "free.ply")
    save_splat(bounded(looks, 0.05).scene, tmp_path / "safe.ply")
    (tmp_path / "p.toml").write_text('bounded = 0.05\nclaims = ["readable"]\n')
    lines = [json.dumps(str(tmp_path / name)) for name in ("free.ply", "safe.ply")]
    policy = ("--policy", str(tmp_path / "p.toml"))
    status, told = run(capsys, monkeypatch, tmp_path, lines, *policy)
    assert status == 3
    assert told["safe.ply"]["verdict"] == "accept"
    assert told["free.ply"]["verdict"] == "refuse"
    (reason,) = told["free.ply"]["claims"]["hidden appearance"]["reasons"]
    assert reason["rule"] == "unbounded"


def test_a_line_without_an_end_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save_splat(cloud(), tmp_path / "fine.ply")
    lines = ["x" * 1_000_000, json.dumps(str(tmp_path / "fine.ply"))]
    status, told = run(capsys, monkeypatch, tmp_path, lines, "--only", "lint")
    assert status == 1
    assert told["fine.ply"]["verdict"] == "accept"
    (long,) = (line for name, line in told.items() if name != "fine.ply")
    assert long["verdict"] == "not judged"
    assert len(json.dumps(long)) < 4000


def test_a_policy_that_cannot_be_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for rule, says in (
        ('giant = "reject"', "refuse, got reject"),
        ('giants = "refuse"', "got giants"),
    ):
        (tmp_path / "p.toml").write_text(f"[rules]\n{rule}\n")
        assert cli.main(["gate", "a.ply", "--policy", str(tmp_path / "p.toml")]) == 1
        assert says in capsys.readouterr().err


def test_a_verdict_without_features_is_not_taken_for_one_with_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without downloaded features less is found, so that the file is judged anew."""
    save_splat(standing("suitcase", count=900).scene, tmp_path / "s.ply")
    lines = [json.dumps({"file": str(tmp_path / "s.ply")})]
    store = Store(tmp_path / "store")
    for has_features, kept in ((False, 1), (False, 1), (True, 2)):
        monkeypatch.setattr(gated, "has_features", lambda found=has_features: found)
        run(capsys, monkeypatch, tmp_path, lines)
        assert len(store.keys()) == kept
