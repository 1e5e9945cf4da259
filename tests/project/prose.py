"""Links, alternative text and banned words of the pages:
`python -m tests.project.prose`, which `make lint` runs.
"""

import re
import sys
from collections.abc import Mapping
from pathlib import Path

from tests.project.documented_commands import ROOT, pages

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

STYLE = ROOT / "docs" / "style.toml"
_HIDDEN = re.compile(r"^(`{3,}|~{3,}).*?^\1`*$|<!--.*?-->", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"(`+)(.+?)\1", re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)")


def anchors(text: str) -> set[str]:
    """Names of the headings of a page, as a forge and the site make them."""
    headings = re.findall(
        r"^#{1,6} (.+?)\s*$", _HIDDEN.sub("", text), flags=re.MULTILINE
    )
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in headings)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in plain
    }


def dead_links(path: Path, text: str) -> list[str]:
    """Links of a page to a missing file or heading, or to an address without https."""
    dead = []
    for *_, address in _LINK.findall(_CODE.sub("`code`", _HIDDEN.sub("", text))):
        target, _, anchor = address.partition("#")
        if "://" in address or address.startswith("mailto:"):
            dead += [] if address.startswith(("https://", "mailto:")) else [address]
            continue
        other = (path.parent / target).resolve() if target else path
        if target and not other.exists():
            dead.append(address)
        elif anchor and (target == "" or other.suffix == ".md"):
            dead += (
                []
                if anchor in anchors(text if not target else other.read_text())
                else [address]
            )
    return dead


def complaints(name: str, text: str, banned: Mapping[str, str]) -> list[str]:
    """Images without alternative text, and banned words with what to write instead."""
    prose = _CODE.sub("`code`", _HIDDEN.sub("", text))
    bare = [
        file for mark, alt, file in _LINK.findall(prose) if mark and not alt.strip()
    ]
    lines = [f"{name}: the image {file} has no alternative text" for file in bare]
    plain = re.sub(r"\s+", " ", _LINK.sub(r"\2", prose))
    for word, instead in banned.items():
        if re.search(rf"\b{word}\b", plain, flags=re.IGNORECASE):
            lines.append(f'{name}: "{word}": write {instead}')
    return lines


def check() -> list[str]:
    """Everything that is wrong with the pages, a line each."""
    banned = tomllib.loads(STYLE.read_text())["banned"]
    lines = list[str]()
    for path in pages():
        name = path.relative_to(ROOT).as_posix()
        text = path.read_text()
        lines += [f"{name}: {link} leads nowhere" for link in dead_links(path, text)]
        # written by programs
        if not name.startswith(("docs/structure.md", "docs/tables/")):
            lines += complaints(name, text, banned)
    return lines


if __name__ == "__main__":
    complained = check()
    # it is a command
    print(*complained, sep="\n", end="\n" if complained else "")  # noqa: T201
    sys.exit(bool(complained))
