"""Trees of frames from ``/tf`` and ``/tf_static``, compared with tf2."""

from __future__ import annotations

import functools
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from smartcam.geometry import Transform

PEER = Path(__file__).with_name("tf2_peer.py")
PYTHON = "/usr/bin/python3"
"""Debian's Python, for which tf2 is built."""

UNPACKED = os.environ.get("SMARTCAM_TF2", "")
"""The folder that Debian's packages of tf2 are unpacked in; "" where none is named."""


class TransformTree:
    """Transforms that were heard, each under its child.

    Where tf2 is there, it has to find the same.
    """

    def __init__(self) -> None:
        self._above: dict[str, Transform] = {}
        self._put: dict[str, tuple[Any, ...]] = {}

    def hear(self, message: Any) -> None:
        """Take in a ``tf2_msgs/TFMessage``; a child has the last parent that was said."""
        for one in message.transforms:
            shift, turn = one.transform.translation, one.transform.rotation
            self.put(
                one.header.frame_id,
                one.child_frame_id,
                (shift.x, shift.y, shift.z),
                (turn.x, turn.y, turn.z, turn.w),
            )

    def put(
        self,
        parent: str,
        child: str,
        place: tuple[float, ...] = (0, 0, 0),
        turn: tuple[float, ...] = (0, 0, 0, 1),
    ) -> None:
        """Have a frame in another one."""
        assert not parent.startswith("/")
        self._above[child] = Transform.from_quaternion(parent, child, place, turn)
        self._put[child] = (parent, child, [*map(float, place)], [*map(float, turn)])

    def lookup(self, target: str, source: str) -> Transform:
        """Return the transform from ``source`` into ``target``, as tf2's lookup_transform does.

        Raises:
            LookupError: one of the two is not known, or no way leads from one to the other.
        """
        judged = self._by_tf2(target, source) if has_tf2() else None
        known = {*self._above, *(one.target for one in self._above.values())}
        try:
            if not {target, source} <= known:
                raise LookupError(f"{target} or {source} does not exist; there are {sorted(known)}")
            down, up = self._to_root(target), self._to_root(source)
            if down.target != up.target:
                raise LookupError(f"{target} and {source} are not connected")
        except LookupError:
            assert judged is None or "error" in judged
            raise
        found = down.inverse() @ up
        if judged is not None:
            theirs = Transform.from_quaternion(target, source, judged["place"], judged["turn"])
            assert np.allclose(theirs.rotation, found.rotation, atol=1e-9)
            assert np.allclose(theirs.translation, found.translation, atol=1e-9)
        return found

    def _to_root(self, frame: str) -> Transform:
        found = Transform(frame, frame, np.eye(3), np.zeros(3))
        while found.target in self._above:
            found = self._above[found.target] @ found
        return found

    def _by_tf2(self, target: str, source: str) -> dict[str, Any]:
        """Return what tf2 finds: a place and a quaternion, or an error."""
        asked = {"target": target, "source": source, "transforms": [*self._put.values()]}
        done = _run([str(PEER)], json.dumps(asked))
        assert done.returncode == 0, done.stderr
        answer: dict[str, Any] = json.loads(done.stdout)
        return answer


@functools.cache
def has_tf2() -> bool:
    """Return True if tf2 can be asked."""
    return Path(PYTHON).exists() and not _run(["-c", "import rospy, tf2_py"], "").returncode


def _run(arguments: list[str], given: str) -> subprocess.CompletedProcess[str]:
    folder = Path(UNPACKED, "usr/lib") if UNPACKED else None
    environment = {
        "PATH": os.environ.get("PATH", ""),
        **(
            {"PYTHONPATH": f"{folder / 'python3/dist-packages'}"}
            | {"LD_LIBRARY_PATH": ":".join(map(str, folder.glob("*-linux-gnu")))}
            if folder
            else {}
        ),
    }
    command = [PYTHON, *arguments]
    return subprocess.run(  # noqa: S603 - Debian's Python
        command, input=given, env=environment, capture_output=True, text=True, check=False
    )
