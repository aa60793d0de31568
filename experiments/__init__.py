"""One file a command: `python -m experiments.NAME`."""

import atexit
import contextlib
import os
import signal
import sys

#: Exit status of a command that a signal has stopped, once it has tidied up.
exit_status: int | None = None


def _leave() -> None:
    """Ends a stopped process as it is: JAX, stopped while it starts, may crash when it is unloaded.

    Registered before any library, it is called after what they have registered.
    """
    if exit_status is not None:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(AttributeError, OSError, ValueError):  # None, full, closed
                stream.flush()
        os._exit(exit_status)


if sys.argv[0] == "-m":
    # A command starts, and this is the first of it that runs. Until `console.one_line_errors` there
    # is nothing that a signal would have to bring to an end: Ctrl-C acts at once, as SIGTERM does.
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    atexit.register(_leave)
