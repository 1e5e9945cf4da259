"""What `mi-splat train` leaves behind: how true the splat is to pictures that it was not trained on."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attacks.report.section import Chart, Figure, Line, Point, Section, plural, settings
from attacks.tables import Table
from mi_splat.io.parsing import read_json
from mi_splat.training.resume import CONFIG


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a training."""
    run, history = read_json(folder / CONFIG), record["history"]
    scored = [line for line in history if line["held_out"] is not None]
    pictures, steps = int(record["held_out_views"]), history[-1]["iteration"]
    exposed = record.get("corrected_psnr")
    return Section(
        kind="training",
        title=folder.name,
        done=(
            f"A splat was trained on {plural(run['views'], 'picture')} in {steps:,} steps, and compared with "
            f"{plural(pictures, 'picture')} that it was not trained on."
        ),
        conclusion=(
            "PSNR says how true the splat is to pictures from the cameras that were held out. It says nothing of other "
            "places, and nothing of whether somebody changed the pictures, which an audit looks for."
        ),
        headline=Figure(
            label="PSNR, held-out pictures",
            words=f"{record['psnr']:.2f} dB" if record["psnr"] is not None else "no picture was held out",
        ),
        attacked=False,
        figures=(
            *([Figure(label="SSIM", words=f"{record['ssim']:.4f}")] if record["ssim"] is not None else []),
            *([Figure(label="PSNR with each picture's exposure", words=f"{exposed:.2f} dB")] if exposed else []),
            Figure(label="Gaussians", words=f"{record['gaussians']:,}"),
        ),
        charts=(
            _chart(
                "PSNR of held-out pictures", "dB", [(step["iteration"], step["held_out"]["psnr"]) for step in scored]
            ),
            _chart("Gaussians", "number", [(step["iteration"], step["count"]) for step in history]),
        ),
        tables=(
            Table.of(
                "In time",
                {
                    "step": lambda line: f"{line['iteration']:,}",
                    "Gaussians": lambda line: f"{line['count']:,}",
                    "loss of the step": lambda line: f"{line['loss']:.4f}",
                    "PSNR, dB": lambda line: f"{line['held_out']['psnr']:.2f}" if line["held_out"] else "-",
                    "SSIM": lambda line: f"{line['held_out']['ssim']:.4f}" if line["held_out"] else "-",
                },
                history,
            ),
        ),
        configuration=settings({**run["config"], "seed": record["seed"], "threads": record["threads"]}),
    )


def _chart(title: str, unit: str, points: list[tuple[float, float]]) -> Chart:
    line = Line(name="training", role="other", points=tuple(Point.of(float(x), float(y)) for x, y in points))
    return Chart(title=title, x_label="step", y_label=unit, lines=(line,), caption="", fractions=False)
