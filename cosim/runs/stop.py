"""Early ends of a run: by SIGINT or SIGTERM after a complete step, or because the run cannot continue."""

import os
import signal
import threading
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


NOTHING_WRITTEN = "interrupted before the first step was done; nothing was written"


class Failed(RuntimeError):
    """A run could not continue because disk space, memory or its folder was missing: one line, exit status 1."""


class Stopped(BaseException):
    """A signal has interrupted the work. The message says what is kept and how to continue."""

    def __init__(self, signum: int, message: str = "interrupted") -> None:
        super().__init__(message)
        self.signum = signum


class StopRequest:
    """Notes the first SIGINT or SIGTERM within its `with` block. A second signal ends the process at once.

    Steps ask whether a signal has come, because an exception from a signal handler cannot pass through compiled code.
    """

    def __init__(self) -> None:
        self.signum: int | None = None
        self.at_once = True
        """Raise Stopped when the signal arrives. If False, the run reads `signum` after every step instead."""
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
