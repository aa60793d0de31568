"""Stopping on SIGTERM or Ctrl-C: at once, or after work that must not be interrupted."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from types import FrameType
from typing import Any, NoReturn

from tdanet_jax import commands

#: Seconds after which a stop that waits for a library, or was dropped, is raised again.
RETRY_SECONDS = 0.05
#: Files whose functions must not be interrupted: the import system, and JAX's start of its
#: backends. If that is interrupted, a timer thread of it keeps running and delays the exit.
STARTING = ("<frozen importlib._bootstrap>", os.path.join("jax", "_src", "xla_bridge.py"))


class Stopped(KeyboardInterrupt):
    """SIGTERM or Ctrl-C was received; `signal` is its number.

    Python drops exceptions that are raised in garbage collection, and some libraries drop those of
    their callbacks. A stop that was dropped is raised again until it has been answered.
    """

    def __init__(self, number: int, request: StopRequest) -> None:
        super().__init__()
        self.signal = number
        self._request = request

    def __del__(self) -> None:
        self._request.ask_again()

    def answer(self) -> NoReturn:
        """Ends the program."""
        self._request.signal = None
        commands.exit_status = 128 + self.signal
        raise SystemExit(commands.exit_status) from None


class StopRequest:
    """Raises `Stopped` on SIGTERM and Ctrl-C: at once, or at the end of `deferred`.

    While a library is imported, or JAX starts a device, the first signal waits: the library may
    crash or hang if that is interrupted.

    Attributes:
      signal: number of the first signal, until it is answered.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._deferring = False
        self._starts = 0  # `_starts` of the frame in which we began to receive
        self._alarm: Any = None  # the handler of SIGALRM before ours
        self._asked = False  # whether the timer is ours

    @contextlib.contextmanager
    def deferred(self) -> Iterator[None]:
        """Inside, the first signal is remembered in `signal`; a second one does not wait."""
        self._check()
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
        self._check()

    def _check(self) -> None:
        if self.signal is not None:
            self._stop(self.signal)

    @contextlib.contextmanager
    def receiving(self) -> Iterator[None]:
        """Inside, this handles the signals that are not ignored; does nothing in other threads."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        self._starts = _starts(sys._getframe())
        self._alarm = signal.getsignal(signal.SIGALRM)
        before = {
            number: signal.signal(number, self._receive)
            for number in (signal.SIGTERM, signal.SIGINT)
            if signal.getsignal(number) is not signal.SIG_IGN
        }
        before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._receive_alarm)
        hook = sys.unraisablehook
        # Dropped exceptions go to this hook, which would print them.
        sys.unraisablehook = lambda told: isinstance(told.exc_value, Stopped) or hook(told)
        try:
            yield
        finally:
            self._deferring = True  # until the previous handlers are back
            if self._asked:
                signal.setitimer(signal.ITIMER_REAL, 0)
            for number, handler in before.items():
                signal.signal(number, handler)
            sys.unraisablehook = hook
            unanswered, self.signal = self.signal, None
            if unanswered is not None:
                signal.raise_signal(unanswered)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            self._stop(number)
        self.signal = number
        self._answer(frame)

    def _receive_alarm(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            self._answer(frame)
        elif callable(self._alarm):
            self._alarm(number, frame)

    def _answer(self, frame: FrameType | None) -> None:
        """Raises `Stopped`, now or later."""
        if self._deferring:
            return
        if _starts(frame) > self._starts:
            self.ask_again()
        else:
            self._check()

    def _stop(self, number: int) -> NoReturn:
        signal.setitimer(signal.ITIMER_REAL, 0)  # nothing else interrupts the clean-up
        raise Stopped(number, self)

    def ask_again(self) -> None:
        """Raises `Stopped` soon if a signal is unanswered; callable in any thread."""
        if self.signal is not None and not self._deferring:
            self._asked = True
            signal.setitimer(signal.ITIMER_REAL, RETRY_SECONDS)


def _starts(frame: FrameType | None) -> int:
    """How many calls that import or start a library are on a frame's stack."""
    return sum(f.f_code.co_filename.endswith(STARTING) for f, _ in traceback.walk_stack(frame))
