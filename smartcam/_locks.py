"""Locks on open files, which the system takes away from a process that ends, however it ends.

They hold among processes and among open files of one process.
"""

from __future__ import annotations

import errno
import os
import sys

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

PLACE = 1 << 62
"""The byte that is locked on Windows, which keeps others from what is locked: behind all data."""

_HELD = frozenset({errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK})


def try_lock(descriptor: int) -> bool | None:
    """Lock an open file, whose place does not change.

    Returns:
        Whether it is ours now, not another one's; None if the file system knows no locks.
    """
    try:
        if sys.platform == "win32":
            place = os.lseek(descriptor, 0, os.SEEK_CUR)
            os.lseek(descriptor, PLACE, os.SEEK_SET)
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            finally:
                os.lseek(descriptor, place, os.SEEK_SET)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as exc:
        return False if exc.errno in _HELD else None
    return True
