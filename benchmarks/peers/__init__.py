"""The other side of the benchmarks: small servers in processes of their own, prepared bytes.

They know no smartcam: what they send is written down here with ``struct``. Each is a module that
prints its port and serves until it is killed.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from typing import TYPE_CHECKING

from benchmarks.cores import for_peers

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

__all__ = ["peer"]

PATIENCE = 30.0
"""Seconds until a process that is told to end is killed."""


@contextlib.contextmanager
def peer(module: str, *arguments: str, under: Sequence[str] = ()) -> Iterator[int]:
    """Run ``benchmarks.peers.<module>``; gives the port that it listens to on 127.0.0.1.

    Args:
        module: its name.
        *arguments: of its command line.
        under: a command that runs it and has something to say when it ends.
    """
    command = [*under, sys.executable, "-m", f"benchmarks.peers.{module}", *arguments]
    with for_peers():
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            raise RuntimeError(f"{' '.join(command)} did not start")
        yield int(line)
    finally:
        if under:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE)
        process.kill()
        process.communicate()
