"""Puts the parts of mi_splat into the wheel, which calls them splat_conformance."""

import re
import shutil
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

MODULES = {
    "mi_splat.conformance": "splat_conformance",
    "mi_splat.oracle": "splat_conformance.oracle",
    "mi_splat.errors": "splat_conformance.errors",
    "mi_splat.maths.srgb": "splat_conformance.srgb",
}
"""What they are called in the wheel."""


def renamed(text: str) -> str:
    """A module with the names that others have in the wheel."""
    for name, new in MODULES.items():
        text = re.sub(rf"\b{re.escape(name)}\b", new, text)
    return text


class CustomBuildHook(BuildHookInterface[Any]):
    """Copies modules, renamed, and the pack."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Say which files the wheel holds."""
        root = Path(self.root).parents[1]
        made = self._made = Path(mkdtemp())
        files = build_data["force_include"]
        files[str(root / "LICENSE")] = "splat_conformance/LICENSE"
        files[str(root / "scenes" / "conformance")] = "splat_conformance/pack"
        sources = {
            "oracle.py": root / "mi_splat" / "oracle.py",
            "errors.py": root / "mi_splat" / "errors.py",
            "srgb.py": root / "mi_splat" / "maths" / "srgb.py",
        }
        for path in (root / "mi_splat" / "conformance").glob("*.py"):
            sources[path.name] = path
        for name, path in sources.items():
            (made / name).write_text(renamed(path.read_text()))
            files[str(made / name)] = f"splat_conformance/{name}"
        (made / "py.typed").touch()
        files[str(made / "py.typed")] = "splat_conformance/py.typed"

    def finalize(
        self, version: str, build_data: dict[str, Any], artifact_path: str
    ) -> None:
        """Remove the copies."""
        shutil.rmtree(self._made)
