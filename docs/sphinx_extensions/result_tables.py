"""The files of docs/tables that hold every figure of results and of detectors, counted
from the rows in docs/artifacts.

They are in the repository, where a forge shows them; the site offers them as downloads
and has no pages of them. `make docs` writes them anew, and
tests/report/test_result_tables.py fails where one of them is out of date.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

    from attacks.bench.row import Row
    from attacks.figures.tables import Table

_LAYERS = "[CLOAK in the finished file: variants](../cloak-layers.md#variants)"
PAGES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "cloak_car_layers": (
        "CLOAK in the finished file",
        "[CLOAK in the finished file](../cloak-layers.md)",
        ("cloak_car_layers", "cloak_car_layers_five"),
    ),
    "cloak_car_layers_edges": (
        "CLOAK in the finished file with a layer for each edge and trained geometry",
        _LAYERS,
        ("cloak_car_layers_edges",),
    ),
    "cloak_car_layers_geometry": (
        "CLOAK in the finished file with the geometry trained",
        _LAYERS,
        ("cloak_car_layers_geometry",),
    ),
    "cloak_car_layers_ground": (
        "CLOAK in the finished file with the ground laid on the car",
        _LAYERS,
        ("cloak_car_layers_ground",),
    ),
    "cloak_car_layers_shadow": (
        "CLOAK in the finished file, the first run, with the shadow hidden",
        _LAYERS,
        ("cloak_car_layers_shadow",),
    ),
    "cloak_car_sector_layers": (
        "CLOAK from the street in the finished file",
        "[CLOAK in the finished file](../cloak-layers.md#from-the-street)",
        ("cloak_car_sector_layers",),
    ),
    "cloak_car_no_shadow": (
        "CLOAK",
        "[CLOAK](../cloak.md#the-study)",
        ("cloak_car_no_shadow",),
    ),
    "cloak_car_stealthy": (
        "CLOAK at 256 x 256 pixels",
        "[CLOAK](../cloak.md#the-study)",
        ("cloak_car_stealthy",),
    ),
    "cloak_three_appearances": (
        "CLOAK with three appearances",
        "[CLOAK](../cloak.md#one-splat-three-appearances)",
        ("cloak_three_appearances",),
    ),
    "cloak_variations": (
        "CLOAK on other cars, objects and viewpoints",
        (
            "[CLOAK on other cars, objects and viewpoints]"
            "(../cloak.md#other-cars-objects-and-viewpoints)"
        ),
        (
            "cloak_new_cars",
            "cloak_second_car",
            "cloak_controls",
            "cloak_design_sector",
            "cloak_design_object",
        ),
    ),
    "cloak_robust": (
        "CLOAK on a victim who audits the images",
        "[The audit of training images](../audit.md#training-without-group-b)",
        ("cloak_robust",),
    ),
    "attack_zoo": (
        "Comparing attack algorithms",
        (
            "[Comparing attack algorithms]"
            "(../transfer.md#comparing-attack-algorithms-pgd-apgd-cw-square)"
        ),
        ("attack_zoo",),
    ),
    "dagger": ("DAGGER", "[DAGGER](../dagger.md)", ("dagger",)),
    "dagger_cameras": (
        "DAGGER from cameras drawn by seed",
        "[DAGGER](../dagger.md#six-pairs-at-cameras-drawn-by-seed)",
        ("dagger_cameras", "dagger_code", "dagger_cameras_random"),
    ),
    "dagger_captures": (
        "DAGGER on real captures",
        "[Real captures](../real-captures.md#dagger)",
        ("dagger_captures",),
    ),
    "dagger_narrow": (
        "DAGGER around a chosen camera, on real captures",
        "[Defences, and what survives](../defences.md#what-survives)",
        ("dagger_narrow",),
    ),
    "dagger_one_view": (
        "DAGGER on one camera of real captures, under other conditions",
        "[Defences, and what survives](../defences.md#what-survives)",
        ("dagger_one_view",),
    ),
    "dagger_eot": (
        "DAGGER from many viewpoints",
        "[DAGGER from many viewpoints](../dagger-eot.md)",
        (
            "dagger_eot_smallest",
            "dagger_eot_pairs",
            "dagger_eot_openimages",
            "dagger_eot_settings",
        ),
    ),
    "dagger_openimages": (
        "DAGGER on a detector of Open Images",
        (
            "[DAGGER on third-party"
            " detectors](../dagger.md#a-detector-trained-on-open-images)"
        ),
        ("dagger_openimages",),
    ),
    "third_party_detectors": (
        "Detectors of another kind",
        "[Detectors](../detectors.md#detectors-of-another-kind)",
        ("third_party_detectors",),
    ),
    "m_ifgsm": (
        "M-IFGSM",
        "[M-IFGSM](../poison-splat.md#m-ifgsm-training-images-that-fool-a-classifier)",
        ("m_ifgsm", "m_ifgsm_sparse"),
    ),
    "poison_splat": (
        "Poison-splat",
        "[Poison-splat](../poison-splat.md)",
        ("poison_splat",),
    ),
    "transfer": (
        "Transferability of DAGGER from one view",
        "[Transferability](../transfer.md)",
        ("transfer",),
    ),
    "transfer_views": (
        "Transferability of DAGGER over held-out views",
        "[Transferability](../transfer.md#over-held-out-views)",
        ("transfer_views",),
    ),
}
"""For each page its title, the page that says what follows, and the folders of
docs/artifacts.
"""


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_pages(app: Sphinx) -> None:
    """Write all tables anew; the tests compare those in the repository."""
    docs = Path(app.srcdir)
    for name, text in tables(docs):
        path = docs / "tables" / name
        if not path.is_file() or path.read_text() != text:
            path.write_text(text)


def tables(docs: Path) -> Iterator[tuple[str, str]]:
    """Every file of docs/tables that is written by this project, and its text."""
    import study_tables
    from detector_figures import compared_page, table_page

    from attacks.bench.row import table_of
    from attacks.figures.result import read_result
    from attacks.figures.tables import markdown

    for name in PAGES:
        yield f"{name}.md", page(name, docs / "artifacts")
    for figures in sorted((docs / "tables" / "detectors").glob("*.json")):
        yield f"detectors/{figures.stem}.md", table_page(figures)
    yield "detectors/compared.md", compared_page()
    results = [
        read_result(folder) for folder in sorted((docs / "bench" / "v1").glob("*"))
    ]
    rows = [(result.record, result.figures) for result in results]
    plain = table_of([row for row in rows if not row[0]["defence"]])
    defended = defences([row for row in rows if row[0]["defence"]])
    for name, title, table in (
        ("bench_v1", "rows of detectors", plain),
        ("bench_v1_defences", "rows of defences", defended),
    ):
        text = markdown(table.head, table.rows)
        yield f"{name}.md", f"# Robustness benchmark: {title}\n\n{text}\n"
    for name in study_tables.STUDIES:
        yield f"study_{name}.md", study_tables.page(name, docs / "tables")


def defences(rows: list[Row]) -> Table:
    """What defences save and cost; a line for each defence, detector and column."""
    from attacks.bench.row import DEFENDED, HEADS
    from attacks.figures.tables import (
        Column,
        Group,
        Table,
        label_at,
        short_rate,
    )

    lines = []
    rows = sorted(rows, key=lambda row: (row[0]["defence"], row[0]["detector"]["name"]))
    for record, figures in rows:
        labels = {"defence": record["defence"], "detector": record["detector"]["name"]}
        for column, head in HEADS.items():
            of_column = figures.where(part=column)
            if of_column.find("robust", scope=DEFENDED) is not None:
                lines.append(({**labels, "attack": head}, of_column))
    heads: dict[str, Column[Group]] = {
        "defence": label_at("defence"),
        "detector": label_at("detector"),
        "attack": label_at("attack"),
        "without it": short_rate("robust", interval=True),
        "with it": short_rate("robust", interval=True, scope=DEFENDED),
        "the attacker knows it": short_rate(
            "robust_if_known", interval=True, scope=DEFENDED
        ),
        "clean, with it": short_rate("clean", interval=True, scope=DEFENDED),
    }
    return Table.of("", heads, lines)


def page(name: str, artifacts: Path) -> str:
    """A page as Markdown, one of `PAGES`, from the folder docs/artifacts."""
    from attacks.figures.result import read_result
    from attacks.figures.tables import sections
    from attacks.report.results import read_section

    title, conclusion, folders = PAGES[name]
    parts = [
        f"# {title}: every figure",
        f"What follows from these figures is in {conclusion}.",
    ]
    for folder in folders:
        result = read_result(artifacts / folder)
        record = result.record
        if "seeds" in record:
            seeds = record["seeds"]
        else:
            seeds = next(iter(record["points"].values()))["seeds"]
        parts.append(
            f"From the rows in `docs/artifacts/{folder}`, made by"
            f" `{record['command']}`, seeds {', '.join(map(str, seeds))}. Manifest:"
            f" `{result.manifest.sha256}`."
        )
        parts.append(sections(read_section(artifacts / folder).tables).strip())
    return "\n\n".join(parts) + "\n"
