"""Renderer as a torch function: batches, bad input, sizes, and memory."""

import math
import resource
from pathlib import Path

import pytest
import torch

from mi_splat import oracle
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.errors import InvalidValueError
from mi_splat.io import SplatFileError, save_splat
from mi_splat.render.renderer import Method, Renderer, RenderSettings, ScreenGradients
from mi_splat.render.scene_files import read_scene
from mi_splat.scene import GaussianScene, merge
from tests.gaussians import varied_scene

VIEW = Camera(
    to_world=orbit_pose((0.0, 0.0, 0.0), azimuth=10.0, elevation=20.0, distance=3.0),
    lens=Lens(focal=40.0, size=(37, 29)),
)


def test_batch_is_one_picture_per_camera() -> None:
    scene = varied_scene(60, degree=1, seed=1)
    cameras = orbit(
        (0.0, 0.0, 0.0),
        count=3,
        elevation=30.0,
        distance=3.0,
        lens=Lens(focal=30.0, size=(24, 18)),
    )
    render = Renderer()
    pictures = render.batch(scene, [*cameras, VIEW])
    assert [tuple(p.shape) for p in pictures] == [(18, 24, 3)] * 3 + [(29, 37, 3)]
    for picture, camera in zip(pictures, [*cameras, VIEW], strict=True):
        assert torch.equal(picture, render(scene, camera))
    assert render.batch(scene, []) == []


def test_batch_gradient_is_the_sum_of_the_single_ones() -> None:
    scene = varied_scene(40, degree=0, seed=1)
    cameras = orbit(
        (0.0, 0.0, 0.0),
        count=2,
        elevation=30.0,
        distance=3.0,
        lens=Lens(focal=30.0, size=(24, 18)),
    )
    render = Renderer()
    together = scene.sh.clone().requires_grad_(True)
    first, second = render.batch(scene.replace(sh=together), cameras)
    (first.sum() + 2 * second.sum()).backward()  # type: ignore[no-untyped-call]
    apart = scene.sh.clone().requires_grad_(True)
    for weight, camera in zip((1, 2), cameras, strict=True):
        (weight * render(scene.replace(sh=apart), camera).sum()).backward()  # type: ignore[no-untyped-call]
    assert together.grad is not None
    assert apart.grad is not None
    torch.testing.assert_close(together.grad, apart.grad)


def test_screen_gradients_are_in_half_pictures_and_know_what_is_visible() -> None:
    """A shift of the principal point moves every centre on the screen by as many
    pixels.
    """
    wide = Camera(to_world=VIEW.to_world, lens=Lens(focal=40.0, size=(64, 16)))
    scene = varied_scene(40, degree=0, seed=1)
    one = scene.select(torch.arange(40) == int(scene.opacities.argmax()))
    away = one.replace(means=one.means + torch.tensor([1e3, 1e3, 0.0]))
    factors = torch.randn(16, 64, 3, generator=torch.Generator().manual_seed(0))

    def value(dx: float, dy: float) -> float:
        view = Camera(
            to_world=VIEW.to_world,
            lens=Lens(focal=40.0, size=(64, 16), principal=(32.0 + dx, 8.0 + dy)),
        )
        return float((torch.from_numpy(oracle.render(one, view).image) * factors).sum())

    gradients = ScreenGradients()
    both = merge(one, away)
    sh = both.sh.clone().requires_grad_(True)
    picture = Renderer(screen_gradients=gradients)(both.replace(sh=sh), wide)
    (picture * factors).sum().backward()  # type: ignore[no-untyped-call]
    step = 1e-5
    x, y = (
        (value(dx, dy) - value(-dx, -dy)) / (2 * step)
        for dx, dy in ((step, 0.0), (0.0, step))
    )
    assert gradients.lengths.tolist() == pytest.approx(
        [math.hypot(32 * x, 8 * y), 0.0], rel=1e-4
    )
    assert gradients.visible.tolist() == [1.0, 0.0]


def test_memory_stays_flat() -> None:
    scene = varied_scene(200, degree=1, seed=0)
    render = Renderer()
    sh = scene.sh.clone().requires_grad_(True)

    def steps(count: int) -> None:
        for _ in range(count):
            render(scene.replace(sh=sh), VIEW).sum().backward()  # type: ignore[no-untyped-call]

    steps(30)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    steps(150)
    # KiB
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 12 * 1024


SCENE = """<scene version="3.0.0">
<integrator type="splat_tile">
  <rgb name="background" value="0.1, 0.2, 0.3"/><float name="near" value="0.5"/>
</integrator>
<shape type="gaussians" id="car"><string name="filename" value="a.ply"/></shape>
<shape type="gaussians" id="street"><string name="filename" value="b.ply"/></shape>
<sensor type="perspective" id="front">
  <float name="fov" value="40"/>
  <transform name="to_world"><lookat origin="3, 1, 1" target="0, 0, 0" up="0, 0, 1"/>
    </transform>
  <film type="hdrfilm"><integer name="width" value="31"/>
    <integer name="height" value="23"/></film>
</sensor></scene>"""


def test_a_scene_is_its_file(tmp_path: Path) -> None:
    first = varied_scene(30, degree=2, seed=1)
    second = varied_scene(20, degree=0, seed=2)
    save_splat(first, tmp_path / "a.ply")
    save_splat(second, tmp_path / "b.ply")
    (tmp_path / "scene.xml").write_text(SCENE)
    loaded = read_scene(tmp_path / "scene.xml")
    assert loaded.objects == {"car": slice(0, 30), "street": slice(30, 50)}
    assert loaded.settings == RenderSettings(background=(0.1, 0.2, 0.3), near=0.5)
    assert (loaded.cameras["front"].width, loaded.cameras["front"].height) == (31, 23)
    assert torch.equal(loaded.scene.means[:30], first.means)
    assert torch.equal(loaded.scene.sh[:30], first.sh)
    assert torch.equal(loaded.scene.sh[30:, :1], second.sh)
    convention = oracle.Convention(near=0.5)
    reference = oracle.render(
        loaded.scene,
        loaded.cameras["front"],
        background=(0.1, 0.2, 0.3),
        convention=convention,
    ).image
    picture = Renderer(loaded.settings)(loaded.scene, loaded.cameras["front"])
    torch.testing.assert_close(
        picture.double(), torch.from_numpy(reference), atol=1e-4, rtol=0
    )


def test_cameras_beyond_what_float32_bears_are_named(tmp_path: Path) -> None:
    for name in ("a.ply", "b.ply"):
        save_splat(varied_scene(3, degree=0, seed=1), tmp_path / name)
    lookat = '<lookat origin="3, 1, 1" target="0, 0, 0" up="0, 0, 1"/>'
    for change, says in (
        (
            (lookat, '<translate x="1e30"/>'),
            "camera position: expected coordinates up to 1e",
        ),
        (
            (
                '<float name="fov" value="40"/>',
                (
                    '<float name="fov" value="40"/><float'
                    ' name="principal_point_offset_x" value="1e20"/>'
                ),
            ),
            "principal: expected",
        ),
    ):
        (tmp_path / "scene.xml").write_text(SCENE.replace(*change))
        with pytest.raises(
            InvalidValueError, match=rf'scene\.xml, sensor "front": {says}'
        ):
            read_scene(tmp_path / "scene.xml")


def test_bad_scenes_say_why(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="no file"):
        read_scene(tmp_path / "none.xml")
    (tmp_path / "text.xml").write_text("not xml")
    with pytest.raises(InvalidValueError, match=r"text\.xml"):
        read_scene(tmp_path / "text.xml")
    (tmp_path / "scene.xml").write_text(SCENE)
    with pytest.raises(SplatFileError, match=r"[ab]\.ply"):
        read_scene(tmp_path / "scene.xml")
    (tmp_path / "empty.xml").write_text(
        '<scene version="3.0.0"><integrator type="splat_tile"/></scene>'
    )
    with pytest.raises(InvalidValueError, match="gaussians shape"):
        read_scene(tmp_path / "empty.xml")


@pytest.mark.parametrize("method", ["tile", "ray"])
def test_a_scene_without_gaussians_has_an_empty_gradient(method: Method) -> None:
    empty = varied_scene(3, degree=1, seed=0).select(torch.zeros(3, dtype=torch.bool))
    sh = empty.sh.clone().requires_grad_(True)
    settings = RenderSettings(method=method, background=(0.2, 0.4, 0.6))
    image = Renderer(settings)(empty.replace(sh=sh), VIEW)
    torch.testing.assert_close(
        image.detach(), torch.tensor(settings.background).expand_as(image)
    )
    (gradient,) = torch.autograd.grad(image.sum(), [sh])
    assert gradient.shape == empty.sh.shape


@pytest.mark.parametrize("method", ["tile", "ray"])
@pytest.mark.parametrize("name", ["means", "sh"])
def test_what_is_not_finite_is_refused_by_name(name: str, method: Method) -> None:
    scene = varied_scene(9, degree=1, seed=0)
    values = getattr(scene, name).clone()
    values[4] = float("nan")
    tensors = [
        values if own == name else old
        for own, old in zip(ATTRIBUTES, scene.tensors(), strict=True)
    ]
    broken = GaussianScene.unchecked(*tensors)
    with pytest.raises(InvalidValueError, match=f"{name}: expected finite numbers"):
        Renderer(RenderSettings(method=method))(broken, VIEW)
