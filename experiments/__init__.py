"""One file a command: `python -m experiments.NAME`."""

import signal
import sys

if sys.argv[0] == "-m":
    # A command starts, and this is the first of it that runs. Until `console.one_line_errors` there
    # is nothing that a signal would have to bring to an end: Ctrl-C acts at once, as SIGTERM does.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
