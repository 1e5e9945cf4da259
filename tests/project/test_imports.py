"""What commands do not wait for: packages that take seconds to import and are not
needed.
"""

import subprocess
import sys

import pytest

HEAVY = "torch._dynamo", "sympy", "torchmetrics", "transformers", "ultralytics"


def ran(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "work",
    [
        (
            "leaf = torch.rand(1, 64, 64, 3, requires_grad=True)\n"
            "from attacks import load_detector\n"
            "detector = load_detector('fasterrcnn_small');"
            " detector.detect(leaf.detach())\n"
            "detector.candidates(leaf)[0].scores.sum().backward()"
        ),
        (
            "from mi_splat.maths.metrics import ssim; ssim(torch.rand(16, 16, 3),"
            " torch.rand(16, 16, 3))\nleaf = torch.rand(3, requires_grad=True);"
            " leaf.sum().backward()\nfrom mi_splat.training.state import Adam;"
            " Adam([{'params': [leaf]}]).step()"
        ),
    ],
    ids=["a detector", "a training"],
)
def test_work_imports_no_package_that_it_does_not_need(work: str) -> None:
    ran(f"import sys, torch\n{work}\nassert not {{*{HEAVY!r}}} & {{*sys.modules}}")


def test_a_torchvision_that_needs_more_of_the_compiler_gets_it() -> None:
    ran(
        "import importlib, sys, types\n"
        "real, tries = importlib.import_module, []\n"
        "def once(name, package=None):\n"
        "    if name == 'torchvision' and not tries:\n"
        "        tries.append(name)\n"
        "        raise ImportError('cannot import name of another version')\n"
        "    return real(name, package)\n"
        "importlib.import_module = once\n"
        "from attacks.detectors.vision import torchvision\n"
        "assert tries and torchvision.ops.nms and 'torch._dynamo' in sys.modules"
    )
