"""The lock that lets one thread at a time use an environment."""

from __future__ import annotations

import threading

from cyclic_env.errors import UsageError


class ExclusiveAccess:
    """Lets one thread at a time into an environment, and refuses others at once. A copy has a lock of its own.

    Raises
    ------
    UsageError
        On entering, if another thread is inside.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise UsageError(
                "the environment is already being stepped by another thread; give each thread one of its own."
            )

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type[ExclusiveAccess], tuple[()]]:
        return ExclusiveAccess, ()
