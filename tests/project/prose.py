"""Links and style of the pages: `python -m tests.project.prose`, which `make lint` runs.

A page has sentences of at most 25 words with at most one figure each, and none of the words that only this project
would understand. Pages that were there before stand in docs/style.toml with what they have above that: these figures
may fall and not rise, and `--shrink` writes them anew. So may the words of all pages together, to the next full
thousand. `--figures` prints the style of every page.
"""

import argparse
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.project.documented_commands import ROOT, pages

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

STYLE = ROOT / "docs" / "style.toml"

_HIDDEN = re.compile(r"^(`{3,}|~{3,}).*?^\1`*$|<!--.*?-->", re.MULTILINE | re.DOTALL)
"""What is no prose: code and comments. The blocks of ::: hold prose, and their marks are taken off below."""
_MARKS = re.compile(r"^(#.*|\|.*|:{3,}.*|:\w[\w-]*:.*|\[\^?[^\]]+\]: .*|---+)$", re.MULTILINE)
_ITEM = re.compile(r"^\s*([-*+]|\d+\.)\s+", re.MULTILINE)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)")
_TAG = re.compile(r"</?(?:table|tr|td|p|img|br|div|a)\b[^<>]*>")
_CODE = re.compile(r"(`+)(.+?)\1", re.DOTALL)
_END = re.compile(r"(?<=[.!?])[\"')*_]*\s+(?=[\"'(*_\[]*[A-Z0-9`])")
_NAMED = re.compile(
    r"\b(?:Mitsuba|Python|Dr\.Jit|torch|version|seeds?|equations?|cameras?|degree|rows?|level|Apache) \d[\w.]*|"
    r"\b\d{4}-\d\d-\d\d\b|\b\d+D\b",
    re.IGNORECASE,
)
"""Numbers that name a thing and count nothing."""
_NUMBER = r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?:\s?(?:%|dB|degrees))?(?![\w])"
_FIGURE = re.compile(rf"{_NUMBER}(?:\s*(?:of|to|x|/|and|or|in|=)\s*{_NUMBER})*")
"""A figure; a range, a pair and so many of so many are one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Style:
    """What is asked of a page.

    Attributes:
        words: At most in a sentence.
        figures: At most in a sentence.
        site: Words of all pages at most, with their tables and code.
        forbidden: Word to what to write in its place.
    """

    words: int
    figures: int
    site: int
    forbidden: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Measured:
    """The style of a page: words and figures of each of its sentences."""

    sentences: tuple[tuple[str, int, int], ...]

    @property
    def words(self) -> int:
        """Of the whole page."""
        return sum(words for _, words, _ in self.sentences)

    def too_much(self, style: Style) -> tuple[int, int]:
        """Sentences with too many words, and with too many figures."""
        return (
            sum(words > style.words for _, words, _ in self.sentences),
            sum(figures > style.figures for _, _, figures in self.sentences),
        )

    def means(self) -> tuple[float, float]:
        """Words and figures of a sentence."""
        number = max(1, len(self.sentences))
        return self.words / number, sum(figures for *_, figures in self.sentences) / number


def words_of(text: str) -> int:
    """Words of a page, with those of its tables and code."""
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def paragraphs(text: str) -> Iterator[str]:
    """The prose of a page, without tables, headings, code and pictures; a link is its text."""
    text = _MARKS.sub("", _HIDDEN.sub("", text))
    text = _TAG.sub("", _CODE.sub("`code`", text))
    while (plain := _LINK.sub(lambda link: "" if link[1] else link[2], text)) != text:
        text = plain
    for part in re.split(r"\n\s*\n", _ITEM.sub("\n\n", text)):
        if re.search(r"\w", part):
            yield " ".join(part.split())


def measured(text: str) -> Measured:
    """The style of a page."""
    sentences = []
    for paragraph in paragraphs(text):
        for sentence in _END.split(paragraph):
            words = sum(bool(re.search(r"\w", word)) for word in sentence.split())
            figures = len(_FIGURE.findall(_NAMED.sub("", sentence)))
            if words:
                sentences.append((sentence, words, figures))
    return Measured(tuple(sentences))


def anchors(text: str) -> set[str]:
    """Names of the headings of a page, as a forge and the site make them."""
    headings = re.findall(r"^#{1,6} (.+?)\s*$", _HIDDEN.sub("", text), flags=re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in plain}


def dead_links(path: Path, text: str, *, written: Sequence[str]) -> list[str]:
    """Links of a page that lead nowhere: no such file, no such heading, an address without https."""
    dead = []
    for *_, address in _LINK.findall(_CODE.sub("`code`", _HIDDEN.sub("", text))):
        target, _, anchor = address.partition("#")
        if "://" in address or address.startswith("mailto:"):
            dead += [] if address.startswith(("https://", "mailto:")) else [address]
            continue
        other = (path.parent / target).resolve() if target else path
        if target and not other.exists():
            if not any(other.is_relative_to(ROOT) and other.relative_to(ROOT).match(file) for file in written):
                dead.append(address)
        elif anchor and (target == "" or other.suffix == ".md"):
            held = text if not target else other.read_text()
            dead += [] if anchor in anchors(held) else [address]
    return dead


def complaints(
    name: str, text: str, style: Style, allowed: tuple[int, int] = (0, 0), *, examples: int = 3
) -> list[str]:
    """What is wrong with the style of a page, a line each."""
    page, lines = measured(text), list[str]()
    kinds = (("words", 1, style.words), ("figures", 2, style.figures))
    for (kind, column, most), have, may in zip(kinds, page.too_much(style), allowed, strict=True):
        if have > may:
            lines.append(f"{name}: {have} sentences of more than {most} {kind}, expected at most {may}: split them")
            worst = sorted(page.sentences, key=lambda sentence: -int(sentence[column]))
            lines += [f"    {sentence[column]}: {sentence[0]}" for sentence in worst[:examples]]
        if have < may:
            lines.append(
                f"{name}: {have} sentences of more than {most} {kind}, and docs/style.toml says {may}: run "
                "python -m tests.project.prose --shrink"
            )
    for paragraph in paragraphs(text):
        for word, instead in style.forbidden.items():
            if re.search(rf"\b{word}\b", paragraph, flags=re.IGNORECASE):
                lines.append(f'{name}: the word "{word}" means nothing to a reader from outside: write {instead}')
    return lines


def read_style() -> tuple[Style, dict[str, tuple[int, int]]]:
    """What is asked of pages, and what is allowed to single ones."""
    document: dict[str, Any] = tomllib.loads(STYLE.read_text())
    style = Style(**{key: document[key] for key in ("words", "figures", "site", "forbidden")})
    return style, {name: (int(words), int(figures)) for name, (words, figures) in document["allowed"].items()}


def by_hand() -> dict[str, Path]:
    """The pages that people write, by their path in the repository."""
    written = ("docs/structure.md", "docs/tables/")
    files = {path.relative_to(ROOT).as_posix(): path for path in pages()}
    return {name: path for name, path in files.items() if not name.startswith(written)}


def words_of_site() -> int:
    """Words of all pages that people write, with their tables and code."""
    return sum(words_of(path.read_text()) for path in by_hand().values())


def shrink() -> None:
    """Write docs/style.toml anew: what is allowed falls to what the pages have; nothing rises."""
    style, allowed = read_style()
    site = min(style.site, math.ceil(words_of_site() / 1000) * 1000)
    have = {name: measured(path.read_text()).too_much(style) for name, path in by_hand().items()}
    least = {
        name: (min(words, have[name][0]), min(figures, have[name][1]))
        for name, (words, figures) in allowed.items()
        if name in have
    }
    lines = [f'"{name}" = [{words}, {figures}]' for name, (words, figures) in sorted(least.items()) if words or figures]
    head, mark, _ = STYLE.read_text().partition("[allowed]\n")
    head = re.sub(r"^site = \d+", f"site = {site}", head, flags=re.MULTILINE)
    STYLE.write_text(head + mark + "\n".join(lines) + "\n")


def figures() -> Iterator[str]:
    """A line for each page: its words, words and figures of a sentence, and sentences above the limits."""
    style, _ = read_style()
    yield f"{'words':>7}{'a sentence':>12}{'figures':>9}{'long':>6}{'crowded':>9}  page"
    every = {name: measured(path.read_text()) for name, path in by_hand().items()}
    total = Measured(tuple(sentence for page in every.values() for sentence in page.sentences))
    for name, page in [*sorted(every.items(), key=lambda item: -item[1].words), ("all pages", total)]:
        (words, counted), (long, crowded) = page.means(), page.too_much(style)
        yield f"{page.words:7}{words:12.1f}{counted:9.2f}{long:6}{crowded:9}  {name}"
    yield f"{words_of_site():7} words with tables and code; docs/style.toml allows {style.site}"


def check() -> list[str]:
    """Everything that is wrong with links and style, a line each."""
    style, allowed = read_style()
    written = (ROOT / ".gitignore").read_text().split()
    lines = [f"docs/style.toml: {name}: no such page" for name in allowed if not (ROOT / name).is_file()]
    for path in pages():
        name, text = path.relative_to(ROOT).as_posix(), path.read_text()
        lines += [f"{name}: {link} leads nowhere" for link in dead_links(path, text, written=written)]
    for name, path in by_hand().items():
        lines += complaints(name, path.read_text(), style, allowed.get(name, (0, 0)))
    if (words := words_of_site()) > style.site:
        lines.append(
            f"the pages have {words} words with their tables and code, expected at most {style.site}: shorten what "
            "says a thing twice (python -m tests.project.prose --figures), or raise `site` of docs/style.toml for a "
            "page of something new"
        )
    return lines


def main(words: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--figures", action="store_true", help="print the style of every page")
    parser.add_argument(
        "--shrink", action="store_true", help="lower what docs/style.toml allows to what the pages have"
    )
    asked = parser.parse_args(words)
    if asked.shrink:
        shrink()
    lines = list(figures()) if asked.figures else check()
    print(*lines, sep="\n", end="\n" if lines else "")  # noqa: T201 - it is a command
    return bool(lines) and not asked.figures


if __name__ == "__main__":
    sys.exit(main())
