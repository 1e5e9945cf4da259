"""`torchvision`, imported without torch's compiler: its RoIAlign imports one function
of it, which takes 1.4 seconds.

Where that import needs more than the stand-in has, as another version of torchvision
may, the compiler is imported.
"""

import importlib
import sys
from types import ModuleType
from typing import Any

_COMPILER = "torch._dynamo"


def _is_compile_supported(device: str) -> bool:
    """The compiler's own answer."""
    answer: bool = importlib.import_module(f"{_COMPILER}.utils").is_compile_supported(
        device
    )
    return answer


def _import_torchvision() -> Any:
    if _COMPILER in sys.modules or "torchvision" in sys.modules:
        return importlib.import_module("torchvision")
    package = ModuleType(_COMPILER)
    utils = ModuleType(f"{_COMPILER}.utils")
    package.__path__ = []
    vars(utils)["is_compile_supported"] = _is_compile_supported
    sys.modules |= {package.__name__: package, utils.__name__: utils}
    try:
        return importlib.import_module("torchvision")
    except (ImportError, AttributeError):
        for name in [
            name for name in sys.modules if name.split(".")[0] == "torchvision"
        ]:
            del sys.modules[name]
    finally:
        for module in (package, utils):
            del sys.modules[module.__name__]
    return importlib.import_module("torchvision")


torchvision = _import_torchvision()
for _part in (
    "models.detection",
    "models.detection.ssd",
    "models.detection.transform",
    "ops",
    "transforms.functional",
):
    importlib.import_module(f"torchvision.{_part}")
