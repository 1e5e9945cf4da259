"""What a new user types first: the version, the completion of a shell, and scenes that
travel with the package.
"""

import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

import mi_splat
from attacks import cli
from mi_splat import errors
from mi_splat.errors import install
from mi_splat.fields import EXAMPLES


def test_the_version_names_the_commit_and_the_packages(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["--version"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith(f"mi-splat {version('mi-splat')}")
    assert all(f"{name} " in second for name in ("python", "mitsuba", "drjit", "torch"))


def test_a_shell_completes_commands_and_their_options(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["--completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert "--elevation" in script
    done = subprocess.run(
        [
            "bash",
            "-c",
            (
                f"{script}\nCOMP_WORDS=(mi-splat dag) COMP_CWORD=1 _shtab_mi_splat;"
                " echo ${COMPREPLY[@]}"
            ),
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "dagger" in done.stdout.split()
    assert cli.main(["--completion", "fish?"]) == 2


@pytest.mark.parametrize("name", [path.stem for path in EXAMPLES.glob("*.xml")])
def test_an_example_is_the_shipped_scene_in_a_small_file(name: str) -> None:
    example = mi_splat.read_scene(f"example:{name}")
    shipped = mi_splat.read_scene(Path(__file__).parents[2] / "scenes" / f"{name}.xml")
    assert example.objects == shipped.objects
    assert example.cameras.keys() == shipped.cameras.keys()
    assert float((example.scene.means - shipped.scene.means).abs().max()) < 1e-4
    assert sum(path.stat().st_size for path in EXAMPLES.iterdir()) <= 4_000_000


def test_an_unknown_example_names_the_nearest(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["info", "example:car_stret"]) == 2
    assert "did you mean car_street?" in capsys.readouterr().err


def test_hints_to_install_suit_a_checkout_and_a_wheel(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert install("view") == "pip install -e '.[view]' in your checkout of mi-splat"
    monkeypatch.setattr(errors, "__file__", str(tmp_path / "mi_splat" / "errors.py"))
    assert install("view") == "pip install 'mi-splat[view]'"


def test_the_demo_is_the_attack_that_its_help_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from attacks.cli import dagger

    given: list[dagger.DaggerOptions] = []
    monkeypatch.setattr(dagger, "run", given.append)
    assert cli.main(["demo", "--out", str(tmp_path / "out"), "--force"]) == 0
    (options,) = given
    assert (options.scene, options.target, options.force) == (
        EXAMPLES / "car_street.xml",
        "person",
        True,
    )
