"""Tables and the curve of a study, made from its records: table.md for people, table.json for machines, curve.png."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.observe.drawing import draw_figure
from attacks.rate import Rate
from mi_splat import provenance
from mi_splat.io.documents import save_json, save_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Record = Mapping[str, Any]

TITLES = {
    "pairs": "The paper's six pairs: one l2 ball over the SH of the object, eps = 5",
    "cameras": "Every other camera of the scene, one at a time",
    "curve": "Smaller balls",
    "linf": "The same in linf",
    "per_gaussian": "A ball for each Gaussian (what the paper's code does)",
    "hide": "Hide: no detection of any class on the object",
    "means": "Means only (metres)",
    "scales": "Scales only (log-scales)",
    "rotations": "Rotations only (quaternion components before normalisation)",
    "opacities": "Opacities only (logits)",
    "views": "Every camera of the scene at once",
}

_COLUMNS = (
    "attack",
    "norm",
    "eps",
    "success",
    "strictly",
    "confidence",
    "original after",
    "steps",
    "PSNR, dB",
    "on the object",
    "noise success",
    "noise best",
    "warnings",
)


def rows(records: Iterable[Record]) -> list[dict[str, Any]]:
    """One row for each setting, over its seeds; figures are medians unless they are called otherwise."""
    groups: dict[tuple[Any, ...], list[Record]] = {}
    for record in records:
        job = record["job"]
        config = job["config"]
        setting = {
            **{name: job[name] for name in ("group", "scene", "object", "target")},
            "attribute": ", ".join(config["attributes"]),
            "norm": config["norm"],
            "eps": config["eps"][0],
        }
        groups.setdefault(tuple(setting.items()), []).append(record["result"])
    return [{**dict(setting), **_row(results)} for setting, results in groups.items()]


def _row(results: Sequence[Record]) -> dict[str, Any]:
    successes = sum(result["success"] for result in results)
    rate = Rate(successes=successes, total=len(results))
    scores = [result["score"] for result in results]
    originals = [max(view["original_confidence"] for view in result["views"]) for result in results]
    return {
        "successes": successes,
        "strict": sum(result["strict"] for result in results),
        "runs": len(results),
        "interval": rate.interval,
        "score": statistics.median(scores),
        "score_least": min(scores),
        "original_after": statistics.median(originals),
        "steps": statistics.median(result["steps"] for result in results),
        "psnr": _median(result["image_psnr"] for result in results),
        "psnr_object": _median(result["image"]["psnr_object"] for result in results),
        "noise_successes": sum(result["noise"]["successes"] for result in results),
        "noise_draws": sum(result["noise"]["draws"] for result in results),
        "noise_best": max((score for result in results for score in result["noise"]["scores"]), default=None),
        "warnings": sorted({warning for result in results for warning in result["warnings"]}),
    }


def _median(values: Iterable[float | None]) -> float | None:
    found = [value for value in values if value is not None]
    return statistics.median(found) if found else None


def by_radius(records: Iterable[Record]) -> list[dict[str, Any]]:
    """For each group, attribute, norm and radius: pairs reached with every seed, successful runs, and the control."""
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows(records):
        group = "pairs" if row["group"] == "curve" else row["group"]
        found.setdefault((group, row["attribute"], row["norm"], row["eps"]), []).append(row)
    lines = []
    for (group, attribute, norm, eps), members in sorted(found.items()):
        rate = Rate(successes=sum(row["successes"] for row in members), total=sum(row["runs"] for row in members))
        lines.append(
            {
                "group": group,
                "attribute": attribute,
                "norm": norm,
                "eps": eps,
                "pairs": len(members),
                "pairs_reached": sum(row["successes"] == row["runs"] for row in members),
                "successes": rate.successes,
                "runs": rate.total,
                "interval": rate.interval,
                "score": statistics.median(row["score"] for row in members),
                "psnr": _median(row["psnr"] for row in members),
                "noise_successes": sum(row["noise_successes"] for row in members),
                "noise_draws": sum(row["noise_draws"] for row in members),
            }
        )
    return lines


def markdown(records: Sequence[Record]) -> str:
    """All tables as one Markdown page."""
    table, lines = rows(records), ["# DAGGER", "", *_preamble(records), "## Smallest balls", ""]
    lines += grid(
        ("group", "attribute", "norm", "eps", "settings reached with every seed", "runs", "PSNR, dB", "noise"),
        [
            (
                line["group"],
                line["attribute"],
                line["norm"],
                f"{line['eps']:g}",
                f"{line['pairs_reached']} of {line['pairs']}",
                f"{line['successes']}/{line['runs']}",
                number(line["psnr"], ".1f"),
                f"{line['noise_successes']}/{line['noise_draws']}",
            )
            for line in by_radius(records)
        ],
    )
    for group in dict.fromkeys(row["group"] for row in table):
        lines += ["", f"## {TITLES.get(group, group)}", ""]
        lines += grid(_COLUMNS, [_cells(row) for row in table if row["group"] == group])
    return "\n".join(lines) + "\n"


def _preamble(records: Sequence[Record]) -> list[str]:
    first = records[0]["result"]
    steps, factor = first["config"]["steps"], first["config"]["step_factor"]
    versions = ", ".join(f"{name} {version}" for name, version in first["versions"].items())
    return [
        f"Detector {first['detector']}; {steps} steps of eps x {factor:g} / {steps}, stopped at the first unambiguous "
        "success. Success: see `config.objective` in the JSONs; strictly: the object's own class is gone, too (below "
        "0.5). Every run is judged on the saved file and an 8-bit PNG. Medians over seeds; noise is random noise of "
        "the size of the attack in the same norm.",
        "",
        f"Versions: {versions}; variant {first['variant']}; commit {first['commit']}.",
        "",
    ]


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        f"{row['object']} to {row['target'] or 'nothing'}",
        row["norm"],
        f"{row['eps']:g}",
        f"{row['successes']}/{row['runs']}",
        f"{row['strict']}/{row['runs']}",
        f"{row['score']:.2f} (least {row['score_least']:.2f})",
        f"{row['original_after']:.2f}",
        f"{row['steps']:g}",
        number(row["psnr"], ".1f"),
        number(row["psnr_object"], ".1f"),
        f"{row['noise_successes']}/{row['noise_draws']}",
        number(row["noise_best"], ".2f"),
        "; ".join(row["warnings"]) or "none",
    )


def number(value: float | None, form: str) -> str:
    """A number in a format, or a dash for none."""
    return "-" if value is None else format(value, form)


def grid(head: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    return [f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *body)]


def write_tables(records: Sequence[Record], out: Path) -> list[Path]:
    """Write table.md and table.json, and curve.png where matplotlib is installed.

    Returns:
        The files written.
    """
    paths = [out / "table.md", out / "table.json"]
    save_text(markdown(records), paths[0])
    save_json({"rows": rows(records), "by_radius": by_radius(records), **provenance.origin()}, paths[1])
    if _draw_curve([line for line in by_radius(records) if line["group"] == "pairs"], out / "curve.png"):
        paths.append(out / "curve.png")
    return paths


def _draw_curve(lines: Sequence[Mapping[str, Any]], path: Path) -> bool:
    """Draw success over eps; False, and nothing is written, without matplotlib (the `figures` extra)."""
    radii = [line["eps"] for line in lines]
    rates = [Rate(successes=line["successes"], total=line["runs"]) for line in lines]
    fractions = [rate.fraction for rate in rates]
    margins = [
        [max(0.0, rate.fraction - rate.interval[0]) for rate in rates],
        [max(0.0, rate.interval[1] - rate.fraction) for rate in rates],
    ]
    noise = [line["noise_successes"] / max(line["noise_draws"], 1) for line in lines]

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.errorbar(radii, fractions, yerr=margins, marker="o", capsize=3, label="DAGGER, 95 % Wilson interval")
        axes.plot(radii, noise, marker="s", linestyle="--", label="random noise of the same size")
        axes.set(xscale="log", ylim=(-0.05, 1.05), xlabel="eps (l2 over the SH of the object)", ylabel="success rate")
        axes.set_xticks(radii, [f"{radius:g}" for radius in radii], minor=False)
        axes.minorticks_off()
        axes.legend(loc="upper left")

    return draw_figure(path, (5.5, 3.6), draw)
