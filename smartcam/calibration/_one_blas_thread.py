"""Limit linear algebra to one thread during a calibration.

The matrices have up to some hundred rows. OpenBLAS divides the work on such a matrix among threads
that wait for each other without sleeping. That takes several times the CPU time, and a hundred
times as long while other work keeps the processors busy.
"""

from __future__ import annotations

import threading
from collections import Counter
from contextlib import ContextDecorator, suppress
from typing import Any

from smartcam._extras import load
from smartcam._forks import notify_of_forks
from smartcam.exceptions import MissingExtraError


class OneBlasThread(ContextDecorator):
    """Limit BLAS to one thread inside of ``with`` or a function; restore the number afterwards.

    Whether the limit applies to the calling thread or to the process depends on the version of
    threadpoolctl (extra ``calibration``). So each thread sets the limit, and restores the number
    that was there before the first limit. Without threadpoolctl nothing changes.
    """

    def __init__(self) -> None:
        self.on_fork()
        notify_of_forks(self)

    def on_fork(self) -> None:
        """Reset the state in a fork; its BLAS may stay limited to one thread."""
        self._lock = threading.Lock()
        self._depths: Counter[int] = Counter()  # number of nested uses in each thread
        self._original_limits: Any = None

    def __enter__(self) -> None:
        thread = threading.get_ident()
        with self._lock, suppress(MissingExtraError):
            self._depths[thread] += 1
            if self._depths[thread] == 1:
                controller = load("threadpoolctl").ThreadpoolController()
                limits = controller.limit(limits=1, user_api="blas")
                self._original_limits = self._original_limits or limits

    def __exit__(self, *_: object) -> None:
        thread = threading.get_ident()
        with self._lock:
            self._depths[thread] -= 1
            if self._depths[thread] > 0:
                return
            del self._depths[thread]
            if self._original_limits is not None:
                self._original_limits.restore_original_limits()
            if not self._depths:
                self._original_limits = None


one_blas_thread = OneBlasThread()
