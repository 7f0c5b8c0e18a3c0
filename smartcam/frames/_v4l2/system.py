"""All system calls of this package, which tests replace."""

from __future__ import annotations

import fcntl
import mmap
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from smartcam.frames._v4l2.abi import Ioctl


SYSFS: Final = Path("/sys/class/video4linux")


def open(path: str) -> int:
    """Open a device in non-blocking mode."""
    return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)


def close(device: int) -> None:
    """Close a device."""
    os.close(device)


def ioctl(device: int, request: Ioctl, argument: bytearray) -> None:
    """Send a request to the driver; its answer is in ``argument``."""
    while True:
        try:
            fcntl.ioctl(device, request.number, argument)
        except InterruptedError:  # interrupted by a signal, before anything was done
            continue
        return


def pages(device: int, length: int, offset: int) -> mmap.mmap:
    """Map a buffer of the driver; slices of the map are copies."""
    return mmap.mmap(device, length, mmap.MAP_SHARED, mmap.PROT_READ, offset=offset)


def nodes() -> dict[str, str]:
    """Return the names of the existing video devices by path; none is opened."""
    paths = sorted(SYSFS.glob("video*"), key=lambda path: (len(path.name), path.name))
    return {f"/dev/{path.name}": _name(path) for path in paths}


def now() -> float:
    """Return the time of the clock that drivers use for frames, seconds."""
    return time.clock_gettime(time.CLOCK_MONOTONIC)


def _name(folder: Path) -> str:
    try:
        return (folder / "name").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:  # the device is being unplugged
        return ""
