"""The tutorial on photographs of others: `python -m scenes.recipes.real_demo`.

Fetches the bananas (`scenes.recipes.real_captures`) and runs every command of
docs/tutorials/attack-your-own-splat.md on them, in its order. `--from CLONE` takes them
from a clone of their repository, where the network does not reach it.
"""

import argparse
import re
import shlex
import subprocess
import sys
from pathlib import Path

from mi_splat.cli.console import show
from scenes.recipes.real_captures import ROOT, FetchError, captures, get

PAGE = ROOT / "docs" / "tutorials" / "attack-your-own-splat.md"
CAPTURE = "banana"
PHOTOGRAPHS = "YOUR_PHOTOS"
OUT = "out/"
INTERACTIVE = "view"
"""The command that waits for somebody to look."""


def commands(photographs: Path, out: Path) -> list[list[str]]:
    """The words of each command of the page after `mi-splat`, for these folders."""
    found = []
    for block in re.findall(r"^```sh\n(.*?)^```$", PAGE.read_text(), re.M | re.S):
        for line in block.splitlines():
            words = shlex.split(line)
            if words[:1] != ["mi-splat"] or words[1] == INTERACTIVE:
                continue
            found.append([placed(word, photographs, out) for word in words[1:]])
    return found


def placed(word: str, photographs: Path, out: Path) -> str:
    """A word of the page with the folders of this run."""
    if word == PHOTOGRAPHS:
        return str(photographs)
    if word.startswith(OUT):
        return f"{out}/{word.removeprefix(OUT)}"
    return word


def main() -> None:
    """Fetch, and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/demo-real"))
    parser.add_argument("--from", dest="clone", type=Path, metavar="CLONE")
    asked = parser.parse_args()
    capture = captures()[CAPTURE]
    folder = asked.out / CAPTURE
    if not folder.exists():
        try:
            get(capture, asked.clone, folder)
        except FetchError as error:
            sys.exit(f"error: {error}")
    show(f"{folder}: by {capture.author}, {capture.licence}, {capture.repository}")
    for words in commands(folder / "images", asked.out):
        show(f"\n$ mi-splat {shlex.join(words)}")
        done = subprocess.run([sys.executable, "-m", "attacks", *words], check=False)
        if done.returncode not in (0, 3):  # 3: an audit that found something
            sys.exit(done.returncode)


if __name__ == "__main__":
    main()
