"""A study on a cluster whose workers have working directories of their own."""

from pathlib import Path

import pytest

from attacks import cli
from tests.ledger.cluster import cluster
from tests.studies.toy import write_toy

STUDY = """study = "compare"
question = "How far are the renderers apart?"
scene = "scene/toy.xml"
methods = ["tile", "ray"]
"""


def test_a_cluster_finds_what_one_process_finds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_toy(tmp_path / "scene")
    monkeypatch.chdir(tmp_path)
    Path("study.toml").write_text(STUDY)
    command = ["study", "run", "study.toml", "--json"]
    with cluster(tmp_path, 2) as (address, _):
        there = ["--scheduler", address, "--store", "there-store", "--out", "there"]
        assert cli.main([*command, *there]) == 0
    here = ["--workers", "0", "--store", "here-store", "--out", "here"]
    assert cli.main([*command, *here]) == 0
    images = [sorted(Path(name).rglob("*.png")) for name in ("there", "here")]
    assert images[0]
    for one, other in zip(*images, strict=True):
        assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("flag", ["--workers", "--megabytes"])
def test_what_a_cluster_decides_is_no_option_of_the_command(
    flag: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_toy(tmp_path / "scene")
    file = tmp_path / "study.toml"
    file.write_text(STUDY.replace("scene/toy.xml", str(tmp_path / "scene/toy.xml")))
    words = ["study", "run", str(file), "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--scheduler", "tcp://127.0.0.1:1", flag, "2"]) == 2
    assert f"{flag}: expected none with --scheduler, got 2" in capsys.readouterr().err
