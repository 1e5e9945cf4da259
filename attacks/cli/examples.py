"""Examples of every command, the commands that go with it, and other names of options; the tests parse them all."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[str, ...]] = {
    "capture": (
        "capture truck.glb --cameras hemisphere:210 --test 20 --out out/truck",
        "capture car:900004 --cameras orbit:36@20 --size 128 --samples 16 --out out/orbit",
    ),
    "train": (
        "train out/truck --out out/truck-splat --iterations 7000",
        "train my_colmap_folder --out out/desk --downscale 2 --max-gaussians 200000",
        "train out/truck --out out/mcmc --strategy mcmc --max-gaussians 50000",
    ),
    "render": (
        "render scenes/car_street.xml --out car.png",
        "render desk.ply --azimuth 40 --elevation 15 --out desk.png",
        "render desk.ply --cameras orbit:60@20 --out desk.gif",
    ),
    "compare": (
        "compare scenes/car_street.xml --methods tile,ray,volprim --cameras all --out out/compare",
        "compare desk.ply --methods tile,folder:pictures --cameras cameras.json --out out/theirs",
    ),
    "select": (
        "select desk.ply --click 320,240 --out picked.png mask.npy",
        "select desk.ply --box -0.2 -0.2 0 0.2 0.2 0.3 --cameras orbit:8@30",
        "select scenes/car_street.xml --object car --out car.ply",
    ),
    "view": ("view desk.ply", "view out/dagger --detectors fasterrcnn_small", "view out/cloak --export cloak.html"),
    "convert": ("convert desk.ply desk.spz", "convert web.ksplat web.ply", "convert desk.ply small.sog --sh-degree 1"),
    "info": ("info desk.ply", "info scenes/car_street.xml --json"),
    "example-scenes": ("example-scenes stop_sign --out out/scenes",),
    "dagger": (
        "dagger scenes/car_street.xml --object car --target person --out out/dagger",
        "dagger scenes/car_street.xml --objective hide --eps 2 --out out/hidden",
        "dagger desk.ply --mask mask.npy --cameras orbit:4@25 --target person --out out/desk",
    ),
    "dagger-eot": (
        "dagger-eot scenes/car_street.xml --object car --target person --out out/dagger-eot",
        "dagger-eot scenes/car_street.xml --object car --elevations 10 30 --jpeg 50 --blur 1 --out out/photographed",
    ),
    "detect": ("detect photo.png desk.ply --cameras orbit:8@20 --out out/detect",),
    "evaluate": ("evaluate desk.ply out/desk/attacked.ply --cameras hemisphere:24 --target person --out out/judged",),
    "study": (
        "study plan scenes/studies/dagger.toml",
        "study run scenes/studies/pairs.toml --out out/studies/pairs",
        "study run scenes/studies/dagger.toml --workers 4",
    ),
    "dagger-sanity": (
        "dagger-sanity scenes/car_street.xml --object car --target person --out out/sanity",
        "dagger-sanity desk.ply --mask mask.npy --azimuth 40 --detectors yolov8n_small --seeds 5 --out out/sanity",
    ),
    "cloak": (
        "cloak scenes/cloak_car_stealthy.toml --forecast",
        "cloak scenes/cloak_demo.toml --out out/cloak",
    ),
    "cloak-experiment": (
        "cloak-experiment surroundings scenes/cloak_demo.toml --results out/cloak",
        "cloak-experiment detection-curve scenes/cloak_demo.toml --results out/cloak --every 1 --out out/curve",
    ),
    "report": (
        "report out/dagger --out dagger.html",
        "report out/cloak out/dagger-eot --out page.html",
    ),
    "rows": ("rows out/dagger", "rows out/cloak --csv", "rows out/cloak --table detections --json"),
    "artifact": (
        "artifact out/cloak --out out/artifact",
        "artifact out/layers --whole --out out/layers-artifact",
    ),
    "artifact-check": (
        "artifact-check out/artifact",
        "artifact-check out/layers-artifact --rescore --every 8",
    ),
    "detectors": (
        "detectors",
        "detectors --json",
        "detectors --get centernet_coco nanodet_coco",
        "detectors --from vladmandic-human-3.3.6.tgz",
    ),
    "train-detector": ("train-detector --detectors fasterrcnn_small --out out/detector",),
    "evaluate-detector": (
        "evaluate-detector --weights out/detector/best.safetensors",
        "evaluate-detector --detectors centernet_coco --out out/centernet.json",
    ),
    "compare-detectors": ("compare-detectors out/detector/held-out.json out/centernet.json",),
    "plot-detector-training": ("plot-detector-training out/detector/curves.json --out curves.png",),
    "doctor": ("doctor",),
}
"""Name of a command to calls of it, without the program's name."""

SEE_ALSO: dict[str, tuple[str, ...]] = {
    "capture": ("train", "render"),
    "train": ("capture", "render", "info"),
    "render": ("info", "compare", "train"),
    "compare": ("render", "report"),
    "select": ("info", "render", "dagger"),
    "view": ("render", "report", "dagger"),
    "convert": ("info", "render"),
    "info": ("render", "select", "convert"),
    "example-scenes": ("render", "dagger"),
    "dagger": ("select", "evaluate", "dagger-eot", "study", "detectors"),
    "dagger-eot": ("dagger", "evaluate", "study", "detectors"),
    "detect": ("detectors", "evaluate"),
    "evaluate": ("dagger", "detect"),
    "dagger-sanity": ("dagger", "evaluate"),
    "study": ("dagger", "dagger-eot", "report"),
    "cloak": ("cloak-experiment", "capture", "train"),
    "cloak-experiment": ("cloak",),
    "report": ("view", "evaluate", "dagger", "cloak"),
    "rows": ("report", "evaluate", "artifact"),
    "artifact": ("artifact-check", "cloak", "dagger-eot"),
    "artifact-check": ("artifact", "evaluate"),
    "detectors": ("dagger", "doctor"),
    "train-detector": ("evaluate-detector", "plot-detector-training"),
    "evaluate-detector": ("compare-detectors", "train-detector"),
    "compare-detectors": ("evaluate-detector", "detectors"),
    "plot-detector-training": ("train-detector",),
    "doctor": ("detectors",),
}
"""Name of a command to others that a user of it looks for."""

ALIASES: dict[str, dict[str, str]] = {
    "train": {
        "position_lr_init": "lr-means",
        "position_lr_final": "lr-means-final",
        "feature_lr": "lr-sh",
        "opacity_lr": "lr-opacities",
        "scaling_lr": "lr-scales",
        "rotation_lr": "lr-rotations",
        "densify_from_iter": "densify-from",
        "densify_until_iter": "densify-until",
        "densification_interval": "densify-interval",
        "cap_max": "max-gaussians",
        "noise_lr": "noise-lr",
    },
}
"""Name of a command to names that options have in the published code of 3DGS and of its MCMC variant."""
