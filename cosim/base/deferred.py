"""Values that are computed when somebody first asks for them."""

from collections.abc import Callable
from threading import Lock
from typing import Generic, TypeVar

T = TypeVar("T")


class Deferred(Generic[T]):
    """A value that is computed once, in the thread that first asks for it; others wait for it.

    What `compute` reads must not change until then. It is let go afterwards.
    """

    def __init__(self, compute: Callable[[], T]) -> None:
        self._compute: Callable[[], T] | None = compute
        self._lock = Lock()
        self._value: T

    def __call__(self) -> T:
        """The value."""
        with self._lock:
            if self._compute is not None:
                self._value = self._compute()
                self._compute = None
        return self._value
