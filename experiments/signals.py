"""Stopping on SIGTERM or Ctrl-C: at once, or after what must not be interrupted."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, NoReturn

import experiments

#: After which a stop that waits for an import, or was dropped, is tried again.
SECONDS_OF_A_MOMENT = 0.05


class Stopped(KeyboardInterrupt):
    """SIGTERM or Ctrl-C came; `signal` is its number.

    Python drops what is raised while it collects garbage, and some libraries drop what is raised
    below them. A stop that was dropped, unless it has been answered, is raised again.
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
        experiments.exit_status = 128 + self.signal
        raise SystemExit(experiments.exit_status) from None


class StopRequest:
    """Turns SIGTERM and Ctrl-C into `Stopped`, at once or, inside `deferred`, at its end.

    While something is imported the first one waits: a library whose import is broken off may crash.

    Attributes:
      signal: the first one's number, until it is answered.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._deferring = False
        self._imports = 0  # how deep in imports we are anyway
        self._alarm: Any = None  # whoever else had SIGALRM
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
        """Inside, the signals come here, but for those that are ignored; none to other threads."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        self._imports = _imports(sys._getframe())
        self._alarm = signal.getsignal(signal.SIGALRM)
        before = {
            number: signal.signal(number, self._receive)
            for number in (signal.SIGTERM, signal.SIGINT)
            if signal.getsignal(number) is not signal.SIG_IGN
        }
        before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._receive_alarm)
        hook = sys.unraisablehook
        # What is dropped is told to this hook, and would be printed.
        sys.unraisablehook = lambda told: isinstance(told.exc_value, Stopped) or hook(told)
        try:
            yield
        finally:
            self._deferring = True  # until whoever had the signals before has them again
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
        if _imports(frame) > self._imports:
            self.ask_again()
        else:
            self._check()

    def _stop(self, number: int) -> NoReturn:
        signal.setitimer(signal.ITIMER_REAL, 0)  # nothing else breaks off the tidying up
        raise Stopped(number, self)

    def ask_again(self) -> None:
        """Has `Stopped` raised in a moment if a signal is unanswered; callable in any thread."""
        if self.signal is not None and not self._deferring:
            self._asked = True
            signal.setitimer(signal.ITIMER_REAL, SECONDS_OF_A_MOMENT)


def _imports(frame: FrameType | None) -> int:
    """How many calls of the import system a frame is in."""
    stack = traceback.walk_stack(frame)
    return sum(f.f_code.co_filename == "<frozen importlib._bootstrap>" for f, _ in stack)


@contextlib.contextmanager
def stoppable(advice: Callable[[], str]) -> Iterator[StopRequest]:
    """Inside, SIGTERM or Ctrl-C ends the program: one line of advice, status 128 + signal."""
    stop = StopRequest()
    with stop.receiving():
        try:
            yield stop
        except Stopped as stopped:
            print(f"stopped; {advice()}")
            stopped.answer()
