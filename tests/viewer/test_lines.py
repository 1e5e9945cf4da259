"""Lines in the world come out where the camera sees them."""

import numpy as np
import torch
from PIL import Image, ImageDraw

from mi_splat.cameras import project_points
from mi_splat.viewer.lines import NEAREST, Lines, arc, draw_lines, frustums, projected
from mi_splat.viewer.orbit import Orbit

CAMERA = Orbit(target=(0, 0, 0), azimuth=0.0, elevation=0.0, distance=4.0, fov=60.0).camera((80, 60))


def test_points_are_projected_as_everywhere_else() -> None:
    segments = torch.randn(20, 2, 3, dtype=torch.float64)
    expected, depth = project_points(segments.reshape(-1, 3), CAMERA)
    assert bool((depth > 0.1).all())
    assert np.allclose(projected(segments, CAMERA).reshape(-1, 2), expected.numpy())


def test_what_is_behind_is_left_out_and_what_reaches_there_is_cut() -> None:
    behind = torch.tensor([[[9.0, 0, 0], [8.0, 1, 0]]], dtype=torch.float64)
    assert projected(behind, CAMERA).shape == (0, 2, 2)
    through = torch.tensor([[[0.0, 0.5, 0], [8.0, 0.5, 0]]], dtype=torch.float64)
    (start, end), (back_end, back_start) = projected(through, CAMERA)[0], projected(through.flip(1), CAMERA)[0]
    assert np.allclose(start, project_points(through[0, :1], CAMERA)[0].numpy())
    cut = torch.tensor([[4.0 - NEAREST, 0.5, 0.0]], dtype=torch.float64)
    assert np.allclose(end, project_points(cut, CAMERA)[0].numpy())
    assert np.allclose((start, end), (back_start, back_end))


def test_a_frustum_is_what_its_camera_sees() -> None:
    edges = frustums([CAMERA], 0.5)
    assert edges.shape == (8, 2, 3)
    corners, depth = project_points(edges[:4, 1], CAMERA)
    assert torch.allclose(depth, torch.full((4,), 0.5, dtype=torch.float64))
    assert corners.round().tolist() == [[0, 0], [80, 0], [80, 60], [0, 60]]
    assert bool((edges[:4, 0] == CAMERA.position).all())
    assert frustums([], 1.0).shape == (0, 2, 3)


def test_an_arc_runs_along_its_sphere() -> None:
    segments = arc((1.0, 2.0, 3.0), 2.0, (10.0, 30.0), (100.0, 30.0))
    offsets = segments - torch.tensor([1.0, 2.0, 3.0])
    assert torch.allclose(offsets.norm(dim=-1), torch.tensor(2.0, dtype=torch.float64))
    assert torch.allclose(offsets[..., 2], torch.tensor(1.0, dtype=torch.float64))  # sin 30 = 1/2
    assert torch.equal(segments[1:, 0], segments[:-1, 1])
    assert len(segments) == 30


def test_lines_are_drawn_in_their_colour() -> None:
    image = Image.new("RGB", (80, 60))
    across = torch.tensor([[[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]], dtype=torch.float64)
    draw_lines(ImageDraw.Draw(image), Lines(segments=across, colour="#ff8000"), CAMERA)
    assert image.getpixel((40, 30)) == (255, 128, 0)
    assert image.getpixel((40, 10)) == (0, 0, 0)
