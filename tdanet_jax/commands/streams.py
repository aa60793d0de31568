"""Output that breaks: a pipe whose reader has ended, or a terminal that was closed."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, TextIO

#: Exit status of a command whose reader has ended, as shells report it.
BROKEN_PIPE = 128 + signal.SIGPIPE


@contextlib.contextmanager
def ends_with_its_reader() -> Iterator[None]:
    """Ends a command silently, with status 141, once the reader of its output exits (`| head`)."""
    try:
        try:
            yield
        finally:
            for stream in _standard_streams():
                stream.flush()
    except BrokenPipeError:
        broken = [stream for stream in _standard_streams() if _is_broken(stream)]
        if not broken:  # it was another pipe
            raise
        for stream in broken:
            _give_up(stream)
        raise SystemExit(BROKEN_PIPE) from None


@contextlib.contextmanager
def output_may_break() -> Iterator[None]:
    """Lets the body continue, after one warning, once its output can no longer be written.

    This happens when the reader of a pipe exits or the terminal is closed; the terminal's signal,
    SIGHUP, is ignored.
    """
    before = sys.stdout, sys.stderr
    hang_up: Any = None
    if threading.current_thread() is threading.main_thread():
        hang_up = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    sys.stdout, sys.stderr = (stream and _Lasting(stream) for stream in before)  # type: ignore[assignment]
    try:
        yield
    finally:
        for stream in _standard_streams():
            stream.flush()
        sys.stdout, sys.stderr = before
        if hang_up is not None:
            signal.signal(signal.SIGHUP, hang_up)


class _Lasting:
    """A text stream that drops what cannot be written; says so on standard error, once."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._broken = False

    def write(self, text: str) -> int:
        self._attempt(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._attempt(self._stream.flush)

    def _attempt(self, act: Callable[[], object]) -> None:
        if self._broken:
            return
        try:
            act()
        except OSError as error:
            self._broken = True
            _give_up(self._stream)
            reason = f"output cannot be written ({error.strerror}); the work goes on without it"
            print(f"warning: {reason}", file=sys.stderr, flush=True)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _standard_streams() -> list[TextIO]:
    """Standard output and error, as far as they are open."""
    return [stream for stream in (sys.stdout, sys.stderr) if stream is not None]


def _is_broken(stream: TextIO) -> bool:
    """Whether a stream has no reader."""
    with contextlib.suppress(AttributeError, OSError, ValueError):  # no file below
        poll = select.poll()
        poll.register(stream.fileno(), 0)
        return bool(poll.poll(0))  # errors alone are reported without being asked for
    try:
        stream.flush()
    except BrokenPipeError:
        return True
    return False


def _give_up(stream: TextIO) -> None:
    """Lets what is still written to a stream, for example at the program's end, go nowhere."""
    with contextlib.suppress(AttributeError, OSError, ValueError):  # no file below
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
