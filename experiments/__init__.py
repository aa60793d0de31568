"""One file a command: `python -m experiments.NAME`."""

import atexit
import os
import signal
import sys

#: Exit status of a command that a signal has stopped, once it has tidied up.
stopped: int | None = None


def _leave() -> None:
    """Ends a stopped process as it is: JAX, stopped while it starts, may crash when it is unloaded.

    Registered before any library, it is called after what they have registered.
    """
    if stopped is not None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(stopped)


if sys.argv[0] == "-m":
    # A command starts, and this is the first of it that runs. Until `console.one_line_errors` there
    # is nothing that a signal would have to bring to an end: Ctrl-C acts at once, as SIGTERM does.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    atexit.register(_leave)
