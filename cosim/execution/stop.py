"""How a run ends early: at SIGINT and SIGTERM after the step, with everything written; or because it cannot go on."""

import os
import signal
import threading
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


NOTHING_WRITTEN = "interrupted before the first step was done; nothing was written"


class Failed(RuntimeError):
    """A run that could not go on for want of disk, memory or its folder: one line, exit status 1."""


class Stopped(BaseException):
    """A signal has ended the work; says what is left of it, and how to go on."""

    def __init__(self, signum: int, message: str = "interrupted") -> None:
        super().__init__(message)
        self.signum = signum


class StopRequest:
    """Notes the first SIGINT or SIGTERM while it is entered; a second one ends the process at once.

    An exception out of a signal handler cannot pass through compiled code, which is why steps ask instead.
    """

    def __init__(self) -> None:
        self.signum: int | None = None
        self.at_once = True
        """Raise Stopped where the signal arrives; False where `signum` is asked after every step."""
        self._before: dict[signal.Signals, object] = {}

    def __enter__(self) -> "StopRequest":
        if threading.current_thread() is threading.main_thread():
            for one in SIGNALS:
                self._before[one] = signal.signal(one, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for one, handler in self._before.items():
            signal.signal(one, handler)  # type: ignore[arg-type]

    def _handle(self, signum: int, frame: FrameType | None) -> None:
        if self.signum is not None:
            signal.signal(signum, signal.SIG_DFL)
            os.kill(os.getpid(), signum)
        self.signum = signum
        if self.at_once:
            raise Stopped(signum, NOTHING_WRITTEN)
