"""Lock open files; the system releases a lock when its process ends, however it ends.

A lock excludes other processes, and other open files of the same process.
"""

from __future__ import annotations

import errno
import os
import sys

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

LOCK_OFFSET = 1 << 62
"""Offset of the byte that is locked on Windows: after all data, so that others may use the data."""

_HELD_BY_OTHER = frozenset({errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK})


def try_lock(descriptor: int) -> bool | None:
    """Lock an open file without moving its position.

    Returns:
        True if this file has the lock now, False if another file has it; None if the file system
            has no locks.
    """
    try:
        if sys.platform == "win32":
            position = os.lseek(descriptor, 0, os.SEEK_CUR)
            os.lseek(descriptor, LOCK_OFFSET, os.SEEK_SET)
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            finally:
                os.lseek(descriptor, position, os.SEEK_SET)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as exc:
        return False if exc.errno in _HELD_BY_OTHER else None
    return True
