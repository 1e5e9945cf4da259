"""Tables of a study of distributions of views, made from its records: table.md for people, table.json for machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.dagger.eot.study import PSNRS
from attacks.dagger.tables import grid, number
from attacks.rate import Rate
from mi_splat import provenance
from mi_splat.io.documents import save_json, save_text

Record = Mapping[str, Any]

TITLES = {
    "pairs": "The paper's six pairs",
    "smallest": "Smaller radii",
    "curve": "Success over the radius, without a limit on the pictures",
    "psnr": "Success over the image budget",
    "pool": "Number of views in the pool (0: new ones at each step)",
    "degree": "Highest SH degree that may change (0: the same colour from everywhere)",
    "changes": "Pictures that change on their way to the detector",
    **{f"attributes{psnr:.0f}": f"Attributes at an image PSNR of {psnr:.0f} dB" for psnr in PSNRS},
}

_COLUMNS = (
    "attack",
    "detectors",
    "what may change",
    "PSNR asked for",
    "azimuths",
    "pool",
    "degree",
    "made for, judged on",
    "held-out views",
    "95 %",
    "PSNR, dB",
    "noise: views, PSNR",
    "clean",
    "steps",
    "seed",
    "seconds",
)


def row(record: Record) -> dict[str, Any]:
    """One attack as one line of a table."""
    job, result = record["job"], record["result"]
    config, rate = job["config"], result["rate"]
    return {
        **{name: job[name] for name in ("group", "scene", "object", "target", "detectors", "confidence")},
        "attributes": config["attributes"],
        "norm": config["norm"],
        "eps": config["eps"],
        "image_budget": config["image_psnr"],
        "azimuths": job["transformations"]["cameras"]["azimuths"],
        "pool": config["pool"],
        "sh_degree": config["sh_degree"],
        "made_for_changes": _changed(job["transformations"]),
        "judged_on_changes": _changed(job["judged"] or job["transformations"]),
        "success": result["success"],
        "successes": rate["successes"],
        "views": rate["total"],
        "interval": rate["interval"],
        "psnr": result["image_psnr"],
        "noise_successes": result["noise_rate"]["successes"],
        "noise_views": result["noise_rate"]["total"],
        "noise_psnr": result["noise_psnr"][0] if result["noise_psnr"] else None,
        "clean_successes": result["clean_rate"]["successes"],
        "unambiguous": result["unambiguous_rate"]["successes"],
        "steps": result["steps"],
        "all_steps": config["steps"],
        "seconds": result["seconds"],
        "seed": config["seed"],
        "warnings": result["warnings"],
    }


def _changed(transformations: Mapping[str, Any]) -> bool:
    """Whether anything happens to the pictures."""
    pictures = transformations["pictures"]
    return any(value != (1.0 if name == "resize" else 0) for name, value in pictures.items())


def smallest_radii(records: Sequence[Record]) -> list[dict[str, Any]]:
    """For each pair, detector, region and SH degree the smallest radius that was enough, the largest that was not."""
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for line in map(row, records):
        if line["group"] == "smallest":
            key = (line["object"], line["target"], tuple(line["detectors"]), tuple(line["azimuths"]), line["sh_degree"])
            found.setdefault(key, []).append(line)
    lines = []
    for (name, target, detectors, azimuths, degree), members in found.items():
        enough = [line for line in members if line["success"]]
        best = min(enough, key=lambda line: line["eps"][0], default=None)
        failed = [line["eps"][0] for line in members if not line["success"]]
        lines.append(
            {
                "object": name,
                "target": target,
                "detectors": list(detectors),
                "azimuths": list(azimuths),
                "sh_degree": degree,
                "smallest": None if best is None else best["eps"][0],
                "psnr": None if best is None else best["psnr"],
                "successes": None if best is None else best["successes"],
                "not_enough": max(failed, default=None),
            }
        )
    return lines


def markdown(records: Sequence[Record]) -> str:
    """All tables as one Markdown page."""
    rows = [row(record) for record in records]
    lines = ["# DAGGER over distributions of views", "", *_preamble(records)]
    if any(line["group"] == "smallest" for line in rows):
        lines += ["", "## Smallest radius that was enough", ""]
        lines += grid(
            (
                "attack",
                "detectors",
                "azimuths",
                "degree",
                "radius",
                "held-out views",
                "PSNR, dB",
                "largest that was not enough",
            ),
            [
                (
                    f"{line['object']} to {line['target']}",
                    ", ".join(line["detectors"]),
                    " to ".join(f"{angle:.0f}" for angle in line["azimuths"]),
                    number(line["sh_degree"], "d"),
                    number(line["smallest"], "g"),
                    number(line["successes"], "d"),
                    number(line["psnr"], ".1f"),
                    number(line["not_enough"], "g"),
                )
                for line in smallest_radii(records)
            ],
        )
    rows.sort(key=lambda line: (line["detectors"], line["object"], line["target"] or ""))
    known = {line["group"] for line in rows}
    for group in [*(title for title in TITLES if title in known), *sorted(known - set(TITLES))]:
        lines += ["", f"## {TITLES.get(group, group)}", ""]
        lines += grid(_COLUMNS, [_cells(line) for line in rows if line["group"] == group])
    return "\n".join(lines) + "\n"


def _preamble(records: Sequence[Record]) -> list[str]:
    result = records[0]["result"]
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    commits = list(dict.fromkeys(str(record["result"]["commit"])[:12] for record in records))
    return [
        "Every attack is judged on the saved file, in 8-bit pictures from held-out cameras of another seed. PSNR is "
        "that of the mean squared error over all pixels of all held-out views. Noise is random noise of the size of "
        "the attack in the same norm, on the same views. Success is "
        f"{result['config']['required_views']:.0%} of the held-out views.",
        "",
        f"Versions: {versions}; variant {result['variant']}; commit {', '.join(commits)}.",
    ]


def _cells(line: Mapping[str, Any]) -> tuple[str, ...]:
    radii = line["eps"] if len(line["eps"]) > 1 else line["eps"] * len(line["attributes"])
    rate = Rate(successes=line["successes"], total=line["views"])
    low, high = rate.interval
    words = {False: "plain", True: "changed"}
    return (
        f"{line['object']} to {line['target'] or 'nothing'}",
        f"{', '.join(line['detectors'])}" + (f" at {line['confidence']:g}" if line["confidence"] else ""),
        f"{line['norm']}: " + ", ".join(f"{n} {e:.3g}" for n, e in zip(line["attributes"], radii, strict=True)),
        number(line["image_budget"], "g"),
        " to ".join(f"{angle:.0f}" for angle in line["azimuths"]),
        str(line["pool"]),
        "-" if line["sh_degree"] is None else str(line["sh_degree"]),
        f"{words[line['made_for_changes']]}, {words[line['judged_on_changes']]}",
        f"{line['successes']}/{line['views']}" + ("" if line["success"] else " (not enough)"),
        f"{low:.0%} to {high:.0%}",
        number(line["psnr"], ".1f"),
        f"{line['noise_successes']}/{line['noise_views']}, {number(line['noise_psnr'], '.1f')}",
        f"{line['clean_successes']}/{line['views']}",
        f"{line['steps']} of {line['all_steps']}",
        str(line["seed"]),
        f"{line['seconds']:.0f}",
    )


def write_eot_tables(records: Sequence[Record], out: Path) -> list[Path]:
    """Write table.md and table.json.

    Returns:
        The files written.
    """
    paths = [out / "table.md", out / "table.json"]
    save_text(markdown(records), paths[0])
    lines = {"rows": [row(record) for record in records], "smallest": smallest_radii(records)}
    save_json({**lines, **provenance.origin()}, paths[1])
    return paths
