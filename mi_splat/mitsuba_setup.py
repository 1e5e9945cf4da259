"""What a process does with Mitsuba first: its log goes to stderr, and its own folder is searched for plugins first."""

import sys
from functools import cache
from pathlib import Path
from typing import Any

from mi_splat.errors import printable


def set_up_mitsuba() -> None:
    """Send what Mitsuba logs to stderr, and take its plugins from its own folder, not from the working directory.

    Mitsuba writes to stdout by itself, which is for results. A log that the caller has set up is kept.
    """
    import mitsuba as mi

    _search_own_folder_first()
    logger = mi.logger()
    for number in reversed(range(logger.appender_count())):
        appender = logger.appender(number)
        if isinstance(appender, mi.StreamAppender) and not appender.logs_to_file():
            logger.remove_appender(appender)
            logger.add_appender(_appender())


@cache
def _search_own_folder_first() -> None:
    """Mitsuba looks for `plugins/NAME.so` in the working directory otherwise, and runs what it finds there."""
    import mitsuba as mi

    mi.file_resolver().prepend(str(Path(str(mi.__file__)).parent))


@cache
def _appender() -> Any:
    """The receiver of log lines; its class needs Mitsuba."""
    import mitsuba as mi

    class StderrAppender(mi.Appender):  # type: ignore[misc]  # Mitsuba's classes have no types for mypy
        """Writes every line of the log to stderr."""

        def append(self, level: object, text: str) -> None:
            """Write one line."""
            sys.stderr.write(f"{printable(text)}\n")

        def log_progress(self, *_: object) -> None:
            """Show no progress; the commands show their own."""

    return StderrAppender()
