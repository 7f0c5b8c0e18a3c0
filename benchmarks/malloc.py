"""The state of the allocator, which is the same in every process that is measured.

glibc maps a block of 128 KiB or more afresh, and unmaps it when it is freed, until a process has
once freed a larger block: from then on blocks up to that size come from the heap. asyncio takes
256 KiB for each ``data_received`` and each datagram, so a process pays 20 to 40 us for each read
until something in it has freed such a block, whatever that was. A yardstick measured in one state
and smartcam in the other say nothing about each other.

So each process of the benchmarks begins with it, the other sides included: :func:`settle` is called
by the package itself. A process that has worked for a while is in this state, and so is one that
has imported enough. How one fares that is not is measured where it matters, by a process whose
threshold is fixed (``UNSETTLED``). Other C libraries have no such threshold; there both do nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["UNSETTLED", "settle"]

BLOCK = 2 << 20
"""Bytes; glibc raises its threshold to the largest block that was freed, 32 MiB at most."""

UNSETTLED: Mapping[str, str] = {"MALLOC_MMAP_THRESHOLD_": str(128 * 1024)}
"""The environment of a process whose threshold stays where it begins, whatever is freed."""


def settle() -> None:
    """Free one large block."""
    bytes(BLOCK)
