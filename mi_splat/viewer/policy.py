"""The Content-Security-Policy of pages: which scripts may run in them, and whom they may ask."""

import base64
import hashlib
import re
from collections.abc import Sequence

import numpy as np
import zstandard

from mi_splat.errors import MiSplatError

_SCRIPT = re.compile(r"<script([^>]*)>(.*?)</script>", re.DOTALL)
_PACKED = re.compile(r'data-p="([^"]*)" data-ss="(\d+)" data-cs="(\d+)"')
_DIGITS = bytes(digit for digit in range(0x21, 0x7F) if digit not in b"\"&'<>`")
"""The 88 digits of viser's packed page."""


NAMING = """
new MutationObserver(() => {
  for (const label of document.querySelectorAll("label[for]"))
    for (const control of label.closest(".mantine-Flex-root")?.querySelectorAll("[role=slider], input, textarea") ?? [])
      if (!control.labels?.length && control.ariaLabel !== label.textContent) control.ariaLabel = label.textContent;
}).observe(document, {childList: true, subtree: true});
"""
"""Script that gives controls of viser without a name the text of the label beside them, for screen readers."""


def script_hash(script: str) -> str:
    """How a policy names an inline script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def viser_scripts(page: str) -> tuple[str, ...]:
    """Hashes of the scripts of viser's page: the one that stands in it, and the one that it unpacks and starts."""
    scripts = _SCRIPT.findall(page)
    packed = _PACKED.search(scripts[0][0]) if len(scripts) == 1 else None
    try:
        if packed is None:
            raise ValueError("not one script that unpacks another")
        style, code = int(packed[2]), int(packed[3])
        content = zstandard.ZstdDecompressor().decompress(_unpacked(packed[1]), max_output_size=style + code)
        if len(content) != style + code:
            raise ValueError(f"{len(content)} bytes in place of {style + code}")
        return script_hash(scripts[0][1]), script_hash(content[style:].decode())
    except (ValueError, zstandard.ZstdError) as error:
        raise MiSplatError(
            f"viser: expected a page whose scripts are known, got {error}; install the version that is asked for"
        ) from error


def viser_policy(scripts: Sequence[str], host: str) -> str:
    """What viser's page may do."""
    return "; ".join(
        (
            "default-src 'none'",
            # No 'unsafe-inline': nothing that stands in a name runs. No 'unsafe-eval': only viser's renderer of splats
            # asks for it, which this page has no use for, and complains in the console. What unpacks the page and every
            # message is WebAssembly.
            f"script-src {' '.join(scripts)} 'wasm-unsafe-eval'",
            "worker-src blob:",  # the connection to the server, whose code is in the page
            # The controls write their colours and places into the page, and these differ from one to the next.
            "style-src 'unsafe-inline'",
            "img-src data: blob:",
            "font-src data:",
            f"connect-src 'self' ws://{host} data:",  # data: is WebAssembly in the page
            "frame-src 'none'",
            "object-src 'none'",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
    )


def _unpacked(text: str) -> bytes:
    """Bytes of a text in base 88: five digits hold four bytes, and the last n digits hold n - 1."""
    values = np.full(256, 88, np.int64)
    values[list(_DIGITS)] = np.arange(88)
    digits = values[np.frombuffer(text.encode("ascii"), np.uint8)]
    lacking = -len(digits) % 5
    groups = np.insert(digits, len(digits) // 5 * 5, np.zeros(lacking, np.int64)).reshape(-1, 5)
    numbers = groups @ (88 ** np.arange(4, -1, -1))
    if (digits == 88).any() or (numbers >= 2**32).any():
        raise ValueError("something else than digits in base 88")
    content = numbers.astype(">u4").tobytes()
    return content[: len(content) - 4] + content[len(content) - 4 + lacking :]
