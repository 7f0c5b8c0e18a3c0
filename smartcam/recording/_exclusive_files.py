"""Open a file so that only one recorder can write it."""

from __future__ import annotations

import os
import stat
from typing import IO, TYPE_CHECKING

from smartcam._locks import try_lock
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path


def open_exclusively(path: Path, *, overwrite: bool) -> IO[bytes]:
    """Open and lock a file for one recorder; truncate it only after it is locked.

    Raises:
        ConfigurationError: another recorder writes the file.
        FileExistsError: the file exists already.
        OSError: the file cannot be created.
    """
    stream = open(path, "wb" if overwrite else "xb", opener=_open_without_truncating)  # noqa: SIM115
    try:
        if stat.S_ISREG(os.fstat(stream.fileno()).st_mode):  # a pipe may have many writers
            if try_lock(stream.fileno()) is False:
                raise ConfigurationError(f"recording {path}: another recorder is writing this file")
            stream.truncate()
    except BaseException:
        stream.close()
        raise
    return stream


def _open_without_truncating(path: str, flags: int) -> int:
    return os.open(path, flags & ~os.O_TRUNC, 0o666)
