"""The service of carla-canvas answers its own client stubs with pictures of our splats (docs/examples)."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mi_splat import Camera, load_splat, look_at
from mi_splat.rendering import Renderer

pytest.importorskip("carla_canvas", reason="carla-canvas is not installed; pip install carla-canvas")
EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
CAR = 7


def test_a_client_gets_our_picture_of_a_car_where_carla_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    import grpc
    from carla_canvas import encodings, load_config
    from carla_canvas.server import load_backend, start
    from carla_canvas.v1 import renderer_pb2 as pb
    from carla_canvas.v1.renderer_pb2_grpc import RendererStub

    monkeypatch.syspath_prepend(str(EXAMPLES))
    config = load_config(EXAMPLES / "canvas.yaml")
    config.renderer["assets"]["maps"] = {"Town*": config.renderer["assets"]["actors"]["vehicle.*"]}
    server, _, port = start(load_backend(config.backend, config.options), "localhost:0", config)
    try:
        client: Any = RendererStub(grpc.insecure_channel(f"localhost:{port}"))
        assert set(client.GetInfo(pb.GetInfoRequest()).sensor_types) >= {"sensor.camera.rgb", "sensor.lidar.ray_cast"}
        with pytest.raises(grpc.RpcError, match="a pattern that fits Nowhere"):
            client.LoadWorld(pb.LoadWorldRequest(map_name="Carla/Maps/Nowhere"))
        client.LoadWorld(pb.LoadWorldRequest(map_name="Carla/Maps/Town01"))
        asked = {"image_size_x": "32", "image_size_y": "24", "fov": "60"}
        size = [pb.ActorAttribute(id=name, value=value) for name, value in asked.items()]
        # CARLA has y to the right: from (0, 8, 1), turned by -90 degrees, one looks at the origin.
        pose = pb.Transform(location=pb.Vector3D(x=1, y=8, z=1), rotation=pb.Rotation(yaw=-90))
        moved = pb.Transform(location=pb.Vector3D(x=2, y=-3), rotation=pb.Rotation(yaw=-30))
        snapshot = pb.WorldSnapshot(timestamp=pb.Timestamp(frame=1, elapsed_seconds=0.1, delta_seconds=0.1))
        snapshot.actors.add(id=CAR, transform=moved)
        for number, kind in enumerate(("rgb", "depth"), start=1):
            sensor = pb.Actor(id=number, type_id=f"sensor.camera.{kind}", attributes=size)
            client.SpawnSensor(pb.SpawnSensorRequest(sensor=sensor))
            snapshot.actors.add(id=number, transform=pose)
        request = pb.RenderRequest(
            snapshot=snapshot,
            new_actors=[pb.Actor(id=CAR, type_id="vehicle.our.car")],
            sensors=[pb.SensorRequest(sensor_id=number, deliver=True) for number in (1, 2)],
        )
        answers = [answer.image for answer in client.Render(request).measurements]
    finally:
        server.stop(grace=None).wait()
    sys.modules.pop("carla_renderer")
    seen, depths = (np.frombuffer(answer.raw_data, np.uint8).reshape(24, 32, 4) for answer in answers)

    from mi_splat.scene import Similarity, merge

    car = load_splat(EXAMPLES.parents[1] / "scenes" / "car_street_car.ply")
    cosine, sine = np.cos(np.pi / 6), np.sin(np.pi / 6)
    turn = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float32)
    both = merge(car, car.transform(Similarity(rotation=turn, translation=torch.tensor([2.0, 3.0, 0.0]))))
    view = look_at((1.0, -8.0, 1.0), (1.0, 0.0, 1.0))
    camera = Camera(to_world=view, focal=16 / np.tan(np.pi / 6), width=32, height=24)
    ours = Renderer().outputs(both, camera)
    wanted = (ours.image.clamp(0, 1) * 255).round().numpy()
    assert np.abs(seen[..., 2::-1] - wanted).max() <= 1
    assert wanted.std() > 20
    there = (ours.alpha >= 0.5).numpy()
    assert np.abs(encodings.decode_depth(depths) - ours.median_depth.numpy())[there].max() < 1e-2
    assert (encodings.decode_depth(depths)[~there] == encodings.DEPTH_FAR).all()
