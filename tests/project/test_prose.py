"""Links, style and spelling of the pages, which `make lint` checks, and that the
checker can fail.
"""

from pathlib import Path

from tests.project import prose


def test_complaints() -> None:
    text = (
        "A [strays](a.md) link, ![](bare.png) and ![an image](a.png).\n\n```sh\ncanopy"
        " ![](none.png)\n```\n`canopy`"
    )
    banned = {"canopy": "occluder", "strays": "outliers"}
    assert prose.complaints("page.md", text, banned) == [
        "page.md: the image bare.png has no alternative text",
        'page.md: "strays": write outliers',
    ]


def test_dead_links(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    other = tmp_path / "other.md"
    other.write_text("# A title\n\n## Two words, `code`\n\n```text\n# none\n```\n")
    good = (
        "[a](other.md) [b](other.md#two-words-code) [c](https://a.example/) [d](#here)"
        " ![e](other.md)\n\n# Here\n"
    )
    assert prose.dead_links(page, good) == []
    bad = (
        "[a](none.md) [b](other.md#none) [c](http://a.example/) [d](#there)"
        " ![e](none.png)"
    )
    dead = ["none.md", "other.md#none", "http://a.example/", "#there", "none.png"]
    assert prose.dead_links(page, bad) == dead
