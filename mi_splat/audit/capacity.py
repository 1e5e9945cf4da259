"""Whether the memory of the machine holds the audit of a file; asked before the file is read."""

import os
from pathlib import Path

from mi_splat.errors import InvalidValueError
from mi_splat.io.errors import from_os_error, path_name
from mi_splat.io.folders import splat_in
from mi_splat.io.formats.detection import HEAD, format_to_read
from mi_splat.io.loaded import open_regular
from mi_splat.io.ply.header import read_header

PROGRAM, PER_GAUSSIAN, COPIES = 700e6, 300, 4
"""Bytes that the program takes without a splat, that each Gaussian takes beside its values, and copies of its values;
measured on a million Gaussians of degree 3."""
_LEAST_FLOATS = 14
"""Values of a Gaussian whose file does not say how many it has: place, size, turn, opacity and colour."""
_MOST_BYTES = {".splat": 32, ".spz": 68}
"""Bytes that a Gaussian takes in a file at most; in every other format but the PLY 248, those of 62 floats."""


def check_capacity(path: Path) -> None:
    """Refuse a splat file whose audit would not fit into the memory that is free.

    What a header says is believed; of a format without a plain header the smallest number of Gaussians is taken that
    a file of its size can hold.
    """
    count, floats = gaussians_of(path)
    wanted, available = PROGRAM + count * (PER_GAUSSIAN + COPIES * 4 * floats), free_memory()
    if wanted > available:
        expected = f"a splat whose audit fits into the {available / 1e9:.1f} GB of memory that are free"
        got = f"at least {count:,} Gaussians, for which {wanted / 1e9:.1f} GB are needed"
        do = "free some memory, take a machine with more, or audit a smaller file and know that it is another one"
        raise InvalidValueError.of(str(path), expected, got, do)


def gaussians_of(path: Path) -> tuple[int, int]:
    """The least numbers of Gaussians, and of values of each, that a file can have, without reading it."""
    name = splat_in(path) or path_name(path)
    try:
        with open_regular(name) as file:
            size, kind = os.fstat(file.fileno()).st_size, format_to_read(name, os.pread(file.fileno(), HEAD, 0))
            if kind != ".ply":
                return size // _MOST_BYTES.get(kind, 248), _LEAST_FLOATS
            vertices = [element for element in read_header(file, name).elements if element.name == "vertex"]
    except OSError as error:
        raise from_os_error(name, "a splat file that can be read", error) from error
    return next(((element.count, max(len(element.properties), _LEAST_FLOATS)) for element in vertices), (0, 0))


def free_memory() -> float:
    """Bytes that this process can still get, of a container or of the machine; all of it where the system says none.

    Files that a container has read and does not use count as its memory until somebody needs it; they are free here.
    """
    limits = [float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")]
    for line in _text("/proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            limits.append(1024 * float(line.split()[1]))
    most, used = _text("/sys/fs/cgroup/memory.max").strip(), _text("/sys/fs/cgroup/memory.current").strip()
    if most.isdigit() and used.isdigit():
        lines = _text("/sys/fs/cgroup/memory.stat").splitlines()
        unused = sum(float(line.split()[1]) for line in lines if line.startswith("inactive_file "))
        limits.append(max(0.0, float(most) - float(used) + unused))
    return min(limits)


def _text(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
