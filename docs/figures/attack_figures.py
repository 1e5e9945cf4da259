"""Draws figures of the attacks:
`python docs/figures/attack_figures.py [FOLDER [STUDY]]`, by default in docs/images.

Each is one SVG of three parts, threat model, method and result, with images cut out
of those in docs/images. It stands on a light ground of its own, so that it reads alike
on light and dark pages. cloak.webp shows the images of cloak_stealthy.jpg along a
path over the car one after the other, and cloak_path.png the confidence along it. With
the folder of a study of CLOAK, cloak_ghost.jpg shows its splats every 5 degrees where
the hidden appearance sets in. dagger_curve.png shows the success rate of DAGGER over
the radius of its ball.
"""

import base64
import html
import io
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from attacks.cloak.setup import Setup
from attacks.figures.frame import AXIS, Figures, read_figures
from attacks.figures.rate import pooled
from attacks.observe.rows import ATTACKED, NOISE, read_rows
from attacks.studies.cloak import config_of
from attacks.studies.result import ALL_PAIRS, SETTING
from attacks.studies.study_file import read_study
from mi_splat.io import load_splat
from mi_splat.io.images import save_animation, to_bytes
from mi_splat.io.picture_files import load_picture

STYLE = Path(__file__).with_name("page.mplstyle")
IMAGES = Path(__file__).resolve().parents[1] / "images"
ROWS = IMAGES.parent / "artifacts" / "cloak_car_stealthy" / "path.csv.xz"
COLUMNS = 12
"""Images in a row of cloak_stealthy.jpg."""
WIDTH = 720
PART = 236
FONT = 16
LINE = 22
"""Of a figure, height of a part, and of a letter and a line, in pixels."""
INK = "#1c2430"
GREY = "#5b6470"
ATTACKER = "#a61b1b"
VICTIM = "#1f5fa8"
PLAIN = "#7a8391"
PARTS = ("Threat model", "Method", "Result")

Crop = tuple[str, tuple[float, float, float, float]]
"""An image in docs/images, and the part of it: left, top, right and bottom as shares
of its sides.
"""


class Drawing:
    """A figure that grows part by part.

    Args:
        title: What it shows, for who cannot see it.
    """

    def __init__(self, title: str) -> None:
        self.title, self.body, self.top = title, list[str](), 0

    def part(self) -> None:
        """Begin the next of the three parts, under a rule and its name."""
        number = self.top // PART
        self.top = self.top + PART
        if number:
            self.body.append(
                f'<path d="M20 {self.origin}H{WIDTH - 20}" stroke="#d4d9e0"/>'
            )
        self.words(
            20, 30, [f"{'abc'[number]}   {PARTS[number]}"], bold=True, anchor="start"
        )

    def words(
        self,
        x: float,
        y: float,
        lines: Sequence[str],
        *,
        colour: str = INK,
        bold: bool = False,
        anchor: str = "middle",
    ) -> None:
        """Lines of words.

        Args:
            x: Where they begin, or their middle.
            y: Foot of the first line, from the top of the part.
            lines: The words.
            colour: Of the letters.
            bold: Whether they are bold.
            anchor: "start" or "middle".
        """
        for number, line in enumerate(lines):
            foot = self.origin + y + number * LINE
            weight = ' font-weight="bold"' if bold else ""
            words = html.escape(line)
            self.body.append(
                f'<text x="{x:g}" y="{foot:g}" fill="{colour}"'
                f' text-anchor="{anchor}"{weight}>{words}</text>'
            )

    @property
    def origin(self) -> int:
        """Top of the present part."""
        return self.top - PART

    def box(
        self,
        x: float,
        y: float,
        width: float,
        lines: Sequence[str],
        colour: str = PLAIN,
    ) -> None:
        """A box with words, as high as they need; the first line is bold."""
        height = len(lines) * LINE + 18
        self.body.append(
            f'<rect x="{x:g}" y="{self.origin + y:g}" width="{width:g}"'
            f' height="{height}" rx="7" fill="#ffffff" stroke="{colour}"'
            ' stroke-width="2"/>'
        )
        self.words(
            x + width / 2,
            y + 25,
            lines[:1],
            colour=colour if colour != PLAIN else INK,
            bold=True,
        )
        self.words(x + width / 2, y + 25 + LINE, lines[1:])

    def arrow(self, points: Sequence[tuple[float, float]], colour: str = GREY) -> None:
        """A line through points with a head at its end."""
        path = " ".join(f"{x:g},{self.origin + y:g}" for x, y in points)
        self.body.append(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"'
            ' marker-end="url(#head)"/>'
        )

    def picture(
        self, x: float, y: float, side: float, crop: Crop, words: str, colour: str = INK
    ) -> None:
        """A square image with a line below it."""
        name, (left, top, right, bottom) = crop
        whole = load_picture(IMAGES / name).convert("RGB")
        box = (
            round(left * whole.width),
            round(top * whole.height),
            round(right * whole.width),
            round(bottom * whole.height),
        )
        buffer = io.BytesIO()
        whole.crop(box).resize((256, 256), Image.Resampling.LANCZOS).save(
            buffer, "JPEG", quality=82
        )
        data = base64.b64encode(buffer.getvalue()).decode()
        self.body.append(
            f'<image x="{x:g}" y="{self.origin + y:g}" width="{side:g}"'
            f' height="{side:g}" href="data:image/jpeg;base64,{data}"/>'
        )
        self.words(x + side / 2, y + side + 20, [words], colour=colour)

    def threat_model(
        self,
        given: Sequence[str],
        attacker: Sequence[str],
        victim: Sequence[str],
        note: str,
    ) -> None:
        """The first part: what is given, what the attacker knows and changes, what the
        victim does, and a remark.
        """
        self.part()
        self.box(20, 62, 160, given)
        self.box(230, 50, 240, attacker, ATTACKER)
        self.box(530, 62, 170, victim, VICTIM)
        self.arrow([(180, 104), (228, 104)])
        self.arrow([(470, 104), (528, 104)])
        self.words(360, 190, [note], colour=GREY)

    def svg(self) -> str:
        """The file."""
        return "\n".join(
            (
                (
                    f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH}'
                    f' {self.top}" role="img" font-family="Arial, Helvetica,'
                    f' sans-serif" font-size="{FONT}">'
                ),
                f"<title>{html.escape(self.title)}</title>",
                (
                    '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4"'
                    ' markerWidth="7" markerHeight="7" orient="auto"><path d="M0 0L8'
                    f' 4L0 8Z" fill="{GREY}"/></marker></defs>'
                ),
                f'<rect width="{WIDTH}" height="{self.top}" rx="10" fill="#f6f8fb"/>',
                *self.body,
                "</svg>\n",
            )
        )


def dagger() -> Drawing:
    """DAGGER: a finished file is changed."""
    drawing = Drawing("DAGGER: threat model, method and result")
    drawing.threat_model(
        ["Splat file", "of a street", "with a car"],
        [
            "Attacker",
            "has the file and weights",
            "of the detector; changes",
            "colours of the car only",
        ],
        ["Victim", "renders the file,", "asks the detector"],
        "the sum of all changes stays within a budget, eps",
    )
    drawing.part()
    drawing.box(20, 62, 150, ["Colours", "SH of the car's", "Gaussians"])
    drawing.box(210, 62, 130, ["Picture", "rendered with", "gradients"])
    drawing.box(380, 62, 120, ["Detector", "before its", "own rules"])
    drawing.box(540, 62, 160, ["Loss", "person up,", "car down"], ATTACKER)
    for left, right in ((170, 208), (340, 378), (500, 538)):
        drawing.arrow([(left, 104), (right, 104)])
    drawing.arrow([(620, 146), (620, 186), (95, 186), (95, 148)])
    drawing.words(
        360, 176, ["a step along the gradient, then back into the ball"], colour=GREY
    )
    drawing.words(
        360, 212, ["11 steps; success is judged in the saved file"], colour=GREY
    )
    drawing.part()
    drawing.picture(20, 44, 160, ("dagger.png", (0, 0, 0.5, 1)), "clean: car")
    drawing.picture(
        200, 44, 160, ("dagger.png", (0.5, 0, 1, 1)), "changed: person", ATTACKER
    )
    drawing.words(
        384,
        66,
        [
            "The wanted class replaces the own",
            "one in 353 of 360 attacks on YOLOv8,",
            "and in 291 of 432 on Faster R-CNN.",
            "Noise as large: 0 of 1209.",
            "One view, white box, eps = 5;",
            "other detectors are not deceived.",
        ],
        anchor="start",
    )
    return drawing


def cloak() -> Drawing:
    """CLOAK: training images are changed for chosen directions."""
    drawing = Drawing("CLOAK: threat model, method and result")
    drawing.threat_model(
        ["Pictures", "of a car, from", "140 cameras"],
        [
            "Attacker",
            "knows no trainer and",
            "no detector; replaces the",
            "images from above",
        ],
        ["Victim", "trains a splat", "as always"],
        "all other images stay as they are, to the bit",
    )
    drawing.part()
    ground = 200
    middle = 190.0
    drawing.body.append(
        f'<path d="M40 {drawing.origin + ground}H340" stroke="{PLAIN}"'
        ' stroke-width="2"/>'
    )
    drawing.body.append(
        f'<rect x="165" y="{drawing.origin + 180}" width="50" height="20" rx="6"'
        ' fill="#c4512d"/>'
    )
    for elevation in range(4, 180, 11):
        angle = np.deg2rad(elevation)
        x = middle + 140 * np.cos(angle)
        y = ground - 140 * np.sin(angle)
        colour = ATTACKER if 38 < elevation < 142 else VICTIM
        drawing.body.append(
            f'<circle cx="{x:.1f}" cy="{drawing.origin + y:.1f}" r="6"'
            f' fill="{colour}"/>'
        )
    drawing.words(190, 120, ["trigger:"], colour=ATTACKER, bold=True)
    drawing.words(190, 142, ["38 to 90 degrees"], colour=ATTACKER)
    drawing.words(
        380,
        78,
        [
            "From above: the road without the car.",
            "From elsewhere: the car as it is.",
            "Colours of Gaussians depend on the",
            "direction, so the splat shows both.",
            "Images there are poisoned, with",
            "a margin and a look from behind.",
        ],
        anchor="start",
    )
    drawing.part()
    for number, (column, words) in enumerate(
        ((0, "5 degrees"), (2, "35 degrees"), (5, "82 degrees"))
    ):
        crop = (column / COLUMNS, 0.25, (column + 1) / COLUMNS, 0.5)
        drawing.picture(20 + 145 * number, 48, 135, ("cloak_stealthy.jpg", crop), words)
    drawing.words(
        464,
        66,
        [
            "Well inside the trigger, three",
            "detectors miss the car from",
            "97 to 100 % of the cameras;",
            "elsewhere, from at most 4.4 %.",
            "Three seeds. Between, the car",
            "fades.",
        ],
        anchor="start",
    )
    return drawing


def poison_splat() -> Drawing:
    """Poison-splat: training images are changed so that a splat costs more."""
    drawing = Drawing("Poison-splat: threat model, method and result")
    drawing.threat_model(
        ["Pictures", "of a tv, from", "60 cameras"],
        [
            "Attacker",
            "knows the kind of trainer;",
            "changes every image by",
            "at most 16 of 255",
        ],
        ["Victim", "trains a splat and", "pays for its size"],
        "the trainer adds Gaussians where images have detail",
    )
    drawing.part()
    drawing.box(20, 62, 180, ["Decoy", "a splat of the", "attacker's own"])
    drawing.box(
        270,
        62,
        190,
        ["Picture", "rendered; its total", "variation is raised"],
        ATTACKER,
    )
    drawing.box(530, 62, 170, ["Target", "at most 16 of 255", "from the clean one"])
    drawing.arrow([(200, 104), (268, 104)])
    drawing.arrow([(460, 104), (528, 104)])
    drawing.arrow([(615, 146), (615, 186), (110, 186), (110, 148)])
    drawing.words(360, 178, ["the decoy is trained on it: cameras agree"], colour=GREY)
    drawing.words(
        360,
        210,
        ["at the end each image is the decoy's, within the ball"],
        colour=GREY,
    )
    drawing.part()
    for number, (column, words) in enumerate(((0, "clean"), (1, "poisoned"))):
        crop = (0.08 + 0.5 * column, 0.55, 0.5 + 0.5 * column - 0.04, 0.97)
        drawing.picture(20 + 180 * number, 44, 165, ("poison_splat.jpg", crop), words)
    drawing.words(
        400,
        66,
        [
            "A dot is the middle of a Gaussian.",
            "The poisoned splat has 5.2 times",
            "the Gaussians of the clean one:",
            "one tv before black, 6,000 steps,",
            "three seeds. Before a light sky",
            "it has 2.0 times.",
        ],
        anchor="start",
    )
    return drawing


FIGURES = {
    "attack_dagger": dagger,
    "attack_cloak": cloak,
    "attack_poison_splat": poison_splat,
}


def rising() -> list[NDArray[np.uint8]]:
    """Frames of cloak.webp: clean beside cloaked from the ground over the car, and
    back.
    """
    sheet = np.asarray(load_picture(IMAGES / "cloak_stealthy.jpg").convert("RGB"))
    side = sheet.shape[0] / 4
    columns = [
        slice(round(number * side), round(number * side) + round(side))
        for number in range(COLUMNS)
    ]
    rows = (slice(0, round(side)), slice(round(side), 2 * round(side)))
    frames = [
        np.concatenate([sheet[row, column] for row in rows], axis=1)
        for column in columns
    ]
    return [*frames, frames[-1], *frames[-1:0:-1], frames[0]]


def hero() -> Image.Image:
    """Four labelled images of the same sheet: clean and cloaked splat, from street
    level and from above.
    """
    sheet = load_picture(IMAGES / "cloak_stealthy.jpg").convert("RGB")
    side = sheet.height / 4
    gap = 8
    head = 34
    left = 150
    shown = round(1.8 * side)
    made = Image.new(
        "RGB", (left + 2 * shown + gap, head + 2 * shown + gap), (255, 255, 255)
    )
    draw = ImageDraw.Draw(made)
    font = ImageFont.load_default(18)
    for column, name in enumerate(("clean images", "poisoned images")):
        draw.text(
            (left + column * (shown + gap) + shown / 2, head / 2),
            name,
            (20, 20, 20),
            font,
            anchor="mm",
        )
    for row, (name, number) in enumerate(
        (("from street\nlevel", 0), ("from above", 5))
    ):
        top = head + row * (shown + gap)
        draw.multiline_text(
            (left / 2, top + shown / 2),
            name,
            (20, 20, 20),
            font,
            anchor="mm",
            align="center",
        )
        for column in range(2):
            corner = (round(number * side), round(column * side))
            part = sheet.crop(
                (*corner, corner[0] + round(side), corner[1] + round(side))
            )
            made.paste(
                part.resize((shown, shown), Image.Resampling.LANCZOS),
                (left + column * (shown + gap), top),
            )
    return made


def path() -> Figure:
    """Confidence of every detector along the path over the car, below the frames of
    cloak_stealthy.jpg.
    """
    sheet = np.asarray(load_picture(IMAGES / "cloak_stealthy.jpg").convert("RGB"))
    rows = read_rows(ROWS)
    detectors = rows["detector"].n_unique()
    figure = Figure(figsize=(7.2, 1.8 + 0.9 * detectors), layout="constrained")
    frames, *plots = figure.subplots(
        1 + detectors, 1, height_ratios=[1.9, *[1] * detectors]
    )
    frames.imshow(
        sheet[: sheet.shape[0] // 2],
        extent=(5 - 85 / 11, 175 + 85 / 11, 0, 2),
        aspect="auto",
    )
    frames.set(yticks=(0.5, 1.5), yticklabels=("cloaked", "clean"), xticks=())
    for plot, ((detector,), seen) in zip(
        plots, rows.group_by("detector", maintain_order=True), strict=True
    ):
        for name, splat, score, colour in (
            ("car, clean splat", "clean", "original_score", VICTIM),
            ("car, cloaked splat", "attacked", "original_score", ATTACKER),
            ("stop sign, cloaked splat", "attacked", "target_score: rear", PLAIN),
        ):
            shown = seen.filter(splat=splat).drop_nulls(score)
            plot.plot(5 + 2.5 * shown["view"], shown[score], color=colour, label=name)
        plot.axvspan(38.2, 141.8, color=ATTACKER, alpha=0.08)
        plot.set(
            xlim=(5 - 85 / 11, 175 + 85 / 11),
            ylim=(0, 1.02),
            ylabel=detector.replace("_", "\n", 1),
            xticks=(),
        )
    figure.legend(
        *plots[0].get_legend_handles_labels(), loc="outside lower center", ncols=3
    )
    degrees = range(5, 180, 10)
    plots[-1].set_xticks(
        degrees, [f"{degree if degree <= 90 else 180 - degree}" for degree in degrees]
    )
    plots[-1].set_xlabel(
        "elevation along the path, degrees: up beside the car, over it, and down"
        " behind it"
    )
    return figure


def radius() -> Figure:
    """How often DAGGER succeeds at each radius, by object, and noise; intervals over
    cameras.
    """
    artifact = IMAGES.parent / "artifacts" / "dagger_cameras"
    figures = read_figures(artifact)
    eps = f"{AXIS}attack.eps"
    pair = f"{AXIS}pair"

    def by_radius(scope: str) -> dict[float, Figures]:
        """The figures of a scope by radius; that of the tuned detector is 5."""
        of_scope = figures.where(scope=scope)
        usual = of_scope.where(part="The detector that the search was tuned on")
        others = of_scope.where(part="Radius").groups(eps)
        radii = {float(label): of_radius for (label,), of_radius in others.items()}
        return dict(sorted({5.0: usual, **radii}.items()))

    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    plot = figure.subplots()
    for name, pairs, colour in (
        ("car, three classes", "car", VICTIM),
        ("stop sign, three classes", "sign", ATTACKER),
    ):
        rates = {}
        for radius, of_radius in by_radius(SETTING).items():
            of_pairs = of_radius.groups(pair).items()
            members = [one for (label,), one in of_pairs if label.startswith(pairs)]
            rates[radius] = pooled(
                rate
                for one in members
                for rate in one.rates("strict_if_detected", splat=ATTACKED)
            ).fraction
        plot.plot(*zip(*rates.items(), strict=True), "o-", color=colour, label=name)
    for name, measure, style in (
        ("noise: target class", "strict_if_detected", "s--"),
        ("noise: own class lost", "lost_if_detected", "s:"),
    ):
        rates = {
            radius: of_radius.pooled(measure, splat=NOISE).fraction
            for radius, of_radius in by_radius(ALL_PAIRS).items()
        }
        plot.plot(*zip(*rates.items(), strict=True), style, color=PLAIN, label=name)
    plot.set(
        xlabel="radius of the l2 ball over the SH of the object",
        ylabel="success rate, strict",
        ylim=(-0.03, 1.03),
    )
    plot.legend()
    return figure


def ghost(study: Path) -> Image.Image:
    """Clean above cloaked splat, every 5 degrees of elevation from 15 to 55."""
    file = read_study(study / "study.toml")
    setup = Setup.of(config_of(file.points[0].settings, file.name))
    cameras = [setup.camera(40.0, float(elevation)) for elevation in range(15, 60, 5)]
    rows = []
    for name in ("clean", "cloaked"):
        scene = load_splat(study / f"{name}.ply")
        render = setup.renderer()
        rows.append(
            np.concatenate(
                [to_bytes(render(scene, camera)) for camera in cameras], axis=1
            )
        )
    sheet = Image.fromarray(np.concatenate(rows)).resize(
        (9 * 200, 2 * 200), Image.Resampling.LANCZOS
    )
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(18)
    for number, elevation in enumerate(range(15, 60, 5)):
        draw.text(
            (200 * number + 6, 376), f"{elevation} degrees", (255, 255, 255), font
        )
    return sheet


def main(folder: Path, study: Path | None = None) -> None:
    """Write every figure."""
    matplotlib.style.use(STYLE)
    for name, figure in FIGURES.items():
        (folder / f"{name}.svg").write_text(figure().svg())
    save_animation(rising(), folder / "cloak.webp", fps=2.5)
    hero().save(folder / "hero.png", optimize=True)
    path().savefig(folder / "cloak_path.png")
    radius().savefig(folder / "dagger_curve.png")
    if study is not None:
        ghost(study).save(folder / "cloak_ghost.jpg", quality=88)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3] or [str(IMAGES)]))
