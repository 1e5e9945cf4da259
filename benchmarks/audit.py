"""What does an audit cost? CPU seconds of one thread, as a ratio to rendering the pictures it looks at; and memory.

    python benchmarks/audit.py [--count 40000] [--json]

The splat is the car of discs of tests/audit/scenes.py on a ground, made by code. Compile time is kept apart: all is
done once before. Memory is the peak of the process, torch and the splat included.
"""

import argparse
import json
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from mi_splat.audit import audit
from mi_splat.rendering import Renderer
from tests.audit.scenes import standing


def cpu_seconds(run: Callable[[], object]) -> float:
    """CPU seconds of this process that a call takes."""
    begun = time.process_time()
    run()
    return time.process_time() - begun


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=40_000, help="number of Gaussians, about")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of lines")
    options = parser.parse_args()
    torch.set_num_threads(1)
    scene = standing("car", count=round(options.count * 2 / 3)).scene.with_degree(3)
    cameras = [camera for item in audit(scene).objects for camera in item.cameras]
    render = Renderer()

    def pictures() -> None:
        with torch.no_grad():
            for camera in cameras:
                render(scene, camera)

    pictures()
    audited, rendered = cpu_seconds(lambda: audit(scene)), cpu_seconds(pictures)
    result = {
        "gaussians": len(scene),
        "pictures": len(cameras),
        "audit, CPU seconds": round(audited, 1),
        "its pictures alone, CPU seconds": round(rendered, 1),
        "ratio": round(audited / rendered, 2),
        "peak, GB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }
    text = json.dumps(result) if options.json else "\n".join(f"{name}: {value}" for name, value in result.items())
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
