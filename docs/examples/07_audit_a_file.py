"""Audit a file.

The audit looks for content that a splat shows from some directions only. It holds out
one cone of directions after another, and compares what the file shows from there with
what all other directions predict. It is given nothing but the file of [example
6](06_cloak_in_the_file.py) (run it first), which contradicts itself from above. Left:
what the file shows from there. Right: the prediction.
"""

from pathlib import Path

import torch
from torchvision.utils import save_image

from attacks.audits.recognition import Recognition
from mi_splat import load_splat, read_scene
from mi_splat.audit import audit

# A small detector of cars and signs says whether two images show the same. It is part
# of the library; with `mi-splat detectors --get prototypes`, the features of a network
# that was trained on photographs are compared as well.
recogniser = Recognition("fasterrcnn_small")

clean = audit(read_scene("scenes/car_street.xml").scene, recogniser)
report = audit(load_splat("out/06_cloaked.ply"), recogniser)
print(f"clean: {clean.answer}")
print(f"cloaked: {report.answer}")

cone = report.contradicted[0]
print(f"confidence in {cone.known_as}: {cone.file_score:.2f} in the file,")
print(f"{cone.file_score + cone.gain:.2f} in what other directions predict")

pair = torch.stack([cone.file[0], cone.prediction[0]]).permute(0, 3, 1, 2)
Path("out").mkdir(exist_ok=True)
save_image(pair, "out/07_audit_a_file.png", padding=0)
