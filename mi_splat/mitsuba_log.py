"""Where Mitsuba's own log goes: to stderr, as stdout is for results."""

import sys
from functools import cache
from typing import Any

from mi_splat.errors import printable


def log_to_stderr() -> None:
    """Send what Mitsuba logs to stderr; it writes to stdout by itself. A log that the caller has set up is kept."""
    import mitsuba as mi

    logger = mi.logger()
    for number in reversed(range(logger.appender_count())):
        appender = logger.appender(number)
        if isinstance(appender, mi.StreamAppender) and not appender.logs_to_file():
            logger.remove_appender(appender)
            logger.add_appender(_appender())


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
