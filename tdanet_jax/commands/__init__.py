"""The commands: one file for each, and what they share. `tdanet` lists them."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys

#: Exit status of a command that was stopped by a signal and has cleaned up.
exit_status: int | None = None


def _leave() -> None:
    """Ends a stopped process at once: JAX, stopped while it starts, may crash when it unloads.

    It is registered before any library's exit functions, so it is called after them.
    """
    if exit_status is not None:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(AttributeError, OSError, ValueError):  # None, full, closed
                stream.flush()
        os._exit(exit_status)


def begin() -> None:
    """Begins a command in a process of its own, before anything large is imported."""
    # Where output is closed (>&-), it goes nowhere; libraries expect that it is there.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    # Until `console.one_line_errors` there is nothing to clean up after a signal: Ctrl-C acts at
    # once, as SIGTERM does.
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    atexit.register(_leave)
