"""A robot drives or flies towards the car of a splat and brakes when a detector finds the car in its pictures.

    python docs/examples/robot.py clean=scenes/car_street.xml attacked=out/hide/attacked.xml --out out/drive

MuJoCo moves the robot, a ball on a straight path with a drive and a brake of limited force, and says when it touches
the car, a box. Ten times a second its camera is rendered from the splat, a detector looks at the picture, and the
controller decides. docs/how-to/a-robot-in-a-splat.md says what comes of it. It needs the extras robots and report.
"""

import argparse
import dataclasses
import importlib.util
import itertools
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attacks.detectors import load_detector
from attacks.detectors.base import Detections, Detector
from attacks.observe.views import detect_views
from attacks.tables import Column, Table
from mi_splat import provenance
from mi_splat.cameras import Camera, RenderFn, look_at, project_box
from mi_splat.cli.console import progress, show, warn
from mi_splat.errors import InvalidValueError, MiSplatError, install, message
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import file_name, save_json, save_png
from mi_splat.io.folders import RECORD, check_new_folder, new_folder
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import open_scene

for module, extra in (("mujoco", "robots"), ("matplotlib", "report")):
    if importlib.util.find_spec(module) is None:
        sys.exit(f"robot.py: {module} is not installed; {install(extra)}")
import mujoco  # noqa: E402

VEHICLES = ("car", "bus", "truck", "train")
"""What the robot brakes for: a car that is taken for a train is in its way all the same."""
BOX = (-2.39, -1.0, 0.0, 2.38, 1.0, 1.45)
"""x0 y0 z0 x1 y1 z1 around the shipped car, metres; that of `capture car:900004` is the same."""
RADIUS, MASS, TIME_STEP = 0.2, 500.0, 0.01
"""Metres and kilograms of the robot; seconds of MuJoCo's step."""
RATE, STANDSTILL = 10.0, 0.05
"""Pictures a second; metres a second."""
AHEAD, ENOUGH = 0.1, 0.9
"""How far a vehicle ahead may lie beside the middle, of the picture's width; of an expected height, what is enough."""
VIEWS = 12
"""Cameras along the path that are kept for an attack on what the robot sees."""


@dataclass(frozen=True, kw_only=True)
class Approach:
    """A straight way to the middle of the car, and how the robot moves on it.

    Attributes:
        speed: Metres a second until it brakes.
        azimuth: Degrees from +x towards +y in which the robot is seen from the car.
        elevation: Degrees above the ground.
        start: Metres along the path between the robot and the car's box at first.
        braking: Metres a second squared that the brake can do.
        confidence: Of a detection that counts.
        reserve: Metres in front of the car at which it wants to stand.
        focal: Of the camera, pixels.
        size: Of its picture, pixels on each side.

    Raises:
        InvalidValueError: A number of these, but an angle, is not positive.
    """

    speed: float = 8.0
    azimuth: float = 0.0
    elevation: float = 0.0
    start: float = 18.0
    braking: float = 6.0
    confidence: float = 0.5
    reserve: float = 2.0
    focal: float = 400.0
    size: int = 256

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name not in ("azimuth", "elevation") and not 0 < value < math.inf:
                raise InvalidValueError(message(field.name, "a positive number", value, "change it"))

    @property
    def direction(self) -> np.ndarray:
        """(3,) from the car to the robot."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


class Robot:
    """The robot and the car in MuJoCo.

    Raises:
        InvalidValueError: The car's box is empty.
    """

    def __init__(self, approach: Approach, box: Sequence[float] = BOX) -> None:
        low, high = np.array(box[:3]), np.array(box[3:])
        self.approach, self.middle, half = approach, (low + high) / 2, (high - low) / 2
        if not bool((half > 0).all()):
            raise InvalidValueError(message("box", "x0 y0 z0 x1 y1 z1 with each 0 below its 1", list(box), "change it"))
        self.corners = torch.tensor(list(itertools.product(*zip(low, high, strict=True))), dtype=torch.float64)
        direction = approach.direction
        with np.errstate(divide="ignore"):
            inside = float(np.min(half / np.abs(direction)))  # of the path, from the middle to the side of the box
        self.start = inside + RADIUS + approach.start
        pose = look_at(direction * self.start + self.middle, self.middle).numpy()
        force = MASS * approach.braking
        self.model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <option timestep="{TIME_STEP}"/>
  <worldbody>
    <geom name="car" type="box" pos="{_text(self.middle)}" size="{_text(half)}"/>
    <body name="robot" pos="{_text(direction * self.start + self.middle)}" gravcomp="1">
      <joint name="path" type="slide" axis="{_text(-direction)}"/>
      <geom name="robot" type="sphere" size="{RADIUS}" mass="{MASS}"/>
      <camera name="eye" xyaxes="{_text([*pose[:3, 0], *-pose[:3, 1]])}"/>
    </body>
  </worldbody>
  <actuator><velocity joint="path" kv="{20 * MASS}" forcerange="{-force} {force}"/></actuator>
</mujoco>""")
        self.data = mujoco.MjData(self.model)
        self.data.qvel[0] = approach.speed
        mujoco.mj_forward(self.model, self.data)

    @property
    def distance(self) -> float:
        """Metres of air between the robot and the car's box."""
        robot, car = (self.model.geom(name).id for name in ("robot", "car"))
        return float(mujoco.mj_geomDistance(self.model, self.data, robot, car, 2 * self.start, None))

    @property
    def camera(self) -> Camera:
        """The robot's; MuJoCo's cameras have y up and look along -z."""
        eye, size = self.data.camera("eye"), self.approach.size
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(eye.xmat.reshape(3, 3) * (1, -1, -1))
        pose[:3, 3] = torch.from_numpy(eye.xpos)
        return Camera(to_world=pose, focal=self.approach.focal, width=size, height=size)

    def wants_to_brake(self, detections: Detections) -> bool:
        """Whether a vehicle is seen, and its box is as high as the car's would be where the robot has to brake."""
        score, pixels = in_the_way(detections, self.approach.size)
        if score < self.approach.confidence:
            return False
        speed = float(self.data.qvel[0])
        needed = speed / RATE + speed**2 / (2 * self.approach.braking) + self.approach.reserve
        box = project_box(self.corners, self.camera_at(needed))
        return box is not None and pixels >= ENOUGH * float(box[3] - box[1])

    def move(self, speed: float) -> bool:
        """Go on to the next picture with the aim of a speed; whether the robot has hit the car."""
        self.data.ctrl[0] = speed
        for _ in range(round(1 / (RATE * TIME_STEP))):
            before = float(self.data.qvel[0])
            mujoco.mj_step(self.model, self.data)
            if self.data.ncon:
                self.data.qvel[0] = before
                return True
        mujoco.mj_forward(self.model, self.data)
        return False

    def camera_at(self, distance: float) -> Camera:
        """The robot's, if it were so many metres before the car on its path."""
        pose = self.camera.to_world.clone()
        along = self.start - self.approach.start + distance
        pose[:3, 3] = torch.from_numpy(self.middle + along * self.approach.direction)
        return dataclasses.replace(self.camera, to_world=pose)


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def in_the_way(detections: Detections, size: int) -> tuple[float, float]:
    """Confidence and height in pixels of the surest vehicle ahead; zeros if there is none."""
    reported = zip(detections.labels, detections.scores.tolist(), detections.boxes.tolist(), strict=True)
    vehicles = [(score, box) for label, score, box in reported if label in VEHICLES]
    ahead = [(score, box) for score, box in vehicles if abs(box[0] + box[2] - size) / 2 < AHEAD * size]
    return max(((score, box[3] - box[1]) for score, box in ahead), default=(0.0, 0.0))


def drive(
    scene: GaussianScene, approach: Approach, detector: Detector, render: RenderFn, box: Sequence[float] = BOX
) -> tuple[list[dict[str, Any]], list[np.ndarray]]:
    """Drive once, until the robot stands or hits the car.

    A brake once pulled stays pulled. The last row is where it stands, or the moment of the hit, which no picture shows.

    Returns:
        A row for each picture: time (s), distance (m), speed (m/s), score, braking, hit; and the pictures.
    """
    robot, braking, hit = Robot(approach, box), False, False
    rows, pictures = list[dict[str, Any]](), list[np.ndarray]()
    while not hit:
        (view,) = detect_views(scene, robot.camera, detector, render=render)
        braking = braking or robot.wants_to_brake(view.detections)
        score, _ = in_the_way(view.detections, approach.size)
        rows.append(_row(robot, score=round(score, 4), braking=braking, hit=False))
        pictures.append(view.pixels.numpy())
        if robot.data.qvel[0] < STANDSTILL:
            return rows, pictures
        hit = robot.move(0.0 if braking else approach.speed)
    rows.append({**_row(robot, score=None, braking=braking, hit=True), "distance": 0.0})
    return rows, pictures


def _row(robot: Robot, **more: object) -> dict[str, Any]:
    speed = round(float(robot.data.qvel[0]), 3)
    return {"time": round(float(robot.data.time), 2), "distance": round(robot.distance, 3), "speed": speed, **more}


def outcome(rows: Sequence[dict[str, Any]], confidence: float) -> dict[str, Any]:
    """What came of a drive: whether it stopped, the margin in metres, the speed of the hit, where it saw the car."""
    looked, last = [row for row in rows if row["score"] is not None], rows[-1]
    seen = [row["distance"] for row in looked if row["score"] >= confidence]
    return {
        "stopped": not last["hit"],
        "margin": None if last["hit"] else last["distance"],
        "hit_at": last["speed"] if last["hit"] else 0.0,
        "first_seen": max(seen, default=None),
        "seen": f"{len(seen)} of {len(looked)}",
    }


COLUMNS: dict[str, Column[dict[str, Any]]] = {
    "splat": "splat",
    "detector": "detector",
    "m/s": "speed",
    "elevation": "elevation",
    "seen in": "seen",
    "first seen, m": "first_seen",
    "stops before it, m": "margin",
    "hits it at, m/s": lambda row: None if row["stopped"] else row["hit_at"],
}


def draw(drives: Sequence[dict[str, Any]], confidence: float, path: Path) -> None:
    """Draw what the detectors saw on the first (slowest, lowest) drives, the speeds of the last, and how all ended."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    detectors = list(dict.fromkeys(drive["detector"] for drive in drives))
    fastest = max(drive["speed"] for drive in drives)
    across = "speed" if len({drive["elevation"] for drive in drives}) == 1 else "elevation"
    figure, axes = pyplot.subplots(len(detectors), 3, figsize=(11, 3.1 * len(detectors)), squeeze=False)
    for line, detector in zip(axes, detectors, strict=True):
        for number, splat in enumerate(dict.fromkeys(drive["splat"] for drive in drives)):
            part = [drive for drive in drives if (drive["detector"], drive["splat"]) == (detector, splat)]
            look = {"color": f"C{number}", "marker": "os^v"[number % 4], "markersize": 3, "label": splat}
            seen = [row for row in part[0]["rows"] if row["score"] is not None]
            line[0].plot([row["distance"] for row in seen], [row["score"] for row in seen], **look)
            fast = part[-1]["rows"]
            line[1].plot([row["distance"] for row in fast], [row["speed"] for row in fast], **look)
            line[2].plot([drive[across] for drive in part], [drive["hit_at"] for drive in part], **look)
        line[0].axhline(confidence, color="black", linewidth=1, linestyle=":")
        line[0].set(ylabel=f"{detector}, first drive", xlabel="metres to the car", ylim=(-0.03, 1.03))
        line[1].set(ylabel="m/s, last drive", xlabel="metres to the car", ylim=(-0.05 * fastest, 1.05 * fastest))
        line[2].set(ylabel="m/s when it hits; 0: stopped", xlabel=across, ylim=(-0.05 * fastest, 1.05 * fastest))
        for axis in line[:2]:
            axis.invert_xaxis()
        for axis in line:
            axis.grid(alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="lower center", ncols=4, fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.04, 1, 1))
    figure.savefig(path, dpi=100)


def run(options: argparse.Namespace) -> None:
    """Drive with every splat, detector, speed and elevation; write the rows, a figure and pictures, show a table."""
    splats = dict(word.partition("=")[::2] for word in options.splats)
    if "" in splats.values() or len(splats) < len(options.splats):
        raise InvalidValueError(message("splats", "NAME=FILE, each name once", options.splats, "name each of them"))
    approaches = [
        Approach(**{**options.approach, "speed": speed, "elevation": elevation})
        for speed, elevation in itertools.product(sorted(options.speeds), sorted(options.elevations))
    ]
    first, far = Robot(approaches[0], options.box), approaches[0].start
    cameras = [describe(f"{metres:.1f}m", first.camera_at(metres)) for metres in np.linspace(far, min(far, 1), VIEWS)]
    check_new_folder(options.out, force=options.force)
    scenes = {name: open_scene(Path(file)) for name, file in splats.items()}
    detectors = [load_detector(name) for name in options.detectors]
    drives = list[dict[str, Any]]()
    total = len(splats) * len(detectors) * len(approaches)
    with progress("driving", total=total) as advance, new_folder(options.out, force=options.force) as folder:
        for name, loaded in scenes.items():
            render = Renderer(dataclasses.replace(loaded.settings, near=RADIUS))
            for detector, approach in itertools.product(detectors, approaches):
                rows, pictures = drive(loaded.scene, approach, detector, render, options.box)
                drives.append({"splat": name, "detector": detector.name, **dataclasses.asdict(approach)})
                drives[-1] |= {**outcome(rows, approach.confidence), "rows": rows}
                chosen = np.linspace(0, len(pictures) - 1, 6).round().astype(int)
                strip = f"{name}-{detector.name}-{approach.speed:g}-{approach.elevation:g}.png"
                save_png(np.concatenate([pictures[k] for k in chosen], axis=1), folder / file_name(strip))
                advance(f"drove in {name}")
        document = {"drives": drives, "cameras": cameras, "files": splats, "box": list(options.box)}
        document["fingerprints"] = {detector.name: detector.fingerprint for detector in detectors}
        save_json({**document, **provenance.origin()}, folder / RECORD)
        draw(drives, approaches[0].confidence, folder / "drives.png")
    show(Table.of("Drives", COLUMNS, drives).markdown)


def main(words: Sequence[str]) -> int:
    """The command line; 1 where something is wrong with what it is given."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("splats", nargs="+", metavar="NAME=FILE", help="splats or scene files with the car, by names")
    parser.add_argument("--detectors", nargs="+", default=["yolov8n_small"], help="each drives by itself")
    parser.add_argument("--speeds", nargs="+", type=float, default=[8.0], help="metres a second")
    parser.add_argument("--elevations", nargs="+", type=float, default=[0.0], help="degrees; above 0 it is a drone")
    parser.add_argument("--box", nargs=6, type=float, default=BOX, help="around the car: x0 y0 z0 x1 y1 z1, metres")
    for field in dataclasses.fields(Approach):
        if field.name not in ("speed", "elevation"):
            kind = int if field.name == "size" else float
            parser.add_argument(f"--{field.name}", type=kind, default=field.default)
    parser.add_argument("--out", type=Path, default=Path("out/drive"), help="a new folder")
    parser.add_argument("--force", action="store_true", help="replace an older result")
    options = parser.parse_args(words)
    names = {field.name for field in dataclasses.fields(Approach)}
    options.approach = {name: value for name, value in vars(options).items() if name in names}
    try:
        with provenance.running_command(["python", "docs/examples/robot.py", *words]):
            run(options)
    except MiSplatError as error:
        warn(str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
