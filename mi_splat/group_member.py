"""What every process of a group runs first: it ends as soon as nobody watches it, also
while it still imports its packages.

`python -m mi_splat.group_member MODULE [WORD ...] DESCRIPTOR` runs a module as
`python -m` does; the descriptor is that of its end of the pipe.
"""

import runpy
import select
import sys
import threading

from mi_splat.process_group import end_own_group


def _end_with(descriptor: int) -> None:
    """Wait until the other end of a pipe is closed; what comes through it is left."""
    ends = select.poll()
    ends.register(descriptor, 0)
    ends.poll()
    end_own_group()


def main() -> None:
    """Run the module that the first word names, and give it the others."""
    module = sys.argv.pop(1)
    descriptor = int(sys.argv[-1])
    threading.Thread(target=_end_with, args=(descriptor,), daemon=True).start()
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
