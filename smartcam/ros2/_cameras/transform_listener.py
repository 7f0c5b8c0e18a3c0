"""Receive ``/tf`` and ``/tf_static`` while programs ask for poses of frames, within bounds.

Poses are never extrapolated. A present pose is refused if the newest transform on the way is old: a
robot whose driver has died keeps its last pose in TF.
"""

from __future__ import annotations

import asyncio
import bisect
import collections
import logging
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from smartcam.exceptions import CalibrationError
from smartcam.geometry import Transform
from smartcam.geometry._inside import Code
from smartcam.ros2._cameras.image_messages import utc_of
from smartcam.ros2._node.qos import QoS

if TYPE_CHECKING:
    from collections.abc import Callable

logger: logging.Logger = logging.getLogger("smartcam.ros2")

TYPE: Final = "tf2_msgs/msg/TFMessage"
TOPICS: Final = {"/tf": QoS(depth=100), "/tf_static": QoS(latched=True, depth=100)}
"""Topics of transforms, with the quality of service of tf2's own listener."""

LINGER: Final = 60.0
"""Seconds for which transforms are received after the last request for a pose."""

WAIT: Final = 3.0
"""Seconds of the timeout for a transform that is not known yet."""

MAX_AGE: Final = 2.0
"""Largest age of the newest transform of a moving frame, by its arrival and by its stamp."""

MAX_GAP: Final = 1.0
"""Largest number of seconds between two transforms between which poses are interpolated."""

MAX_EXTRAPOLATION_SECONDS: Final = 0.25
"""Seconds by which a pose may be older than the first received transform, which is then used."""

MAX_STAMP_STEP_BACK: Final = 10.0
"""Largest delay of a stamp behind the newest one; a larger one means that the clock was reset."""

MAX_FRAMES: Final = 2000
"""Largest number of known frames; others are left out, and logged."""

MAX_MOMENTS: Final = 300
"""Number of kept transforms of one frame; beyond it the oldest is dropped."""

MAX_FRAMES_IN_ERROR: Final = 20
"""Largest number of frames that the text of an error names."""

Found = TypeVar("Found")


@dataclass(eq=False)
class _FrameLink:
    """A frame and its parent.

    Attributes:
        child: the frame.
        parent: parent of the frame.
        static: message of a static transform; None if the transform changes.
        times: times of the moments, UTC, in order.
        moments: messages of the transform at these times.
        arrived_at: time of the arrival of the newest one, by the monotonic clock.
    """

    child: str
    parent: str
    static: Any = None
    times: collections.deque[float] = field(
        default_factory=lambda: collections.deque[float](maxlen=MAX_MOMENTS)
    )
    moments: collections.deque[Any] = field(
        default_factory=lambda: collections.deque[Any](maxlen=MAX_MOMENTS)
    )
    arrived_at: float = 0.0

    def add(self, utc: float, message: Any) -> None:
        """Add the frame's transform at a time; ignore one that is older than the newest."""
        if self.times and utc < self.times[-1] - MAX_STAMP_STEP_BACK:  # the clock was set back
            self.times.clear()
            self.moments.clear()
        if not self.times or utc > self.times[-1]:
            self.times.append(utc)
            self.moments.append(message)
            self.arrived_at = time.monotonic()

    def check_new(self) -> None:
        """Raise BAD_TIME if the newest transform is old."""
        silent, behind = time.monotonic() - self.arrived_at, time.time() - self.times[-1]
        if silent > MAX_AGE or abs(behind) > MAX_AGE:
            direction = "behind" if behind > 0 else "ahead of"
            raise Code.BAD_TIME.refusal(
                f"TF: {self.parent} -> {self.child}: the newest transform came {silent:.1f} s ago, "
                f"and its stamp is {abs(behind):.1f} s {direction} this computer's clock; expected "
                f"{MAX_AGE:g} s at most, from a robot that is running and clocks that agree",
                MAX_AGE,
                round(max(silent, abs(behind)), 3),
            )

    def at(self, utc: float) -> Transform:
        """Return the transform at a time, interpolated.

        Raises:
            CalibrationError: BAD_TIME: not known at that time; NOT_RIGID: it is not valid.
        """
        if self.static is not None:
            return _transform(self, self.static, None)
        place = bisect.bisect_left(self.times, utc)
        if place < len(self.times) and self.times[place] == utc:
            return _transform(self, self.moments[place], utc)
        if place == 0 and self.times[0] - utc <= MAX_EXTRAPOLATION_SECONDS:
            return _transform(self, self.moments[0], utc)
        if place in {0, len(self.times)} or self.times[place] - self.times[place - 1] > MAX_GAP:
            raise Code.BAD_TIME.refusal(
                f"TF: {self.parent} -> {self.child}: nothing is known of {_text(utc)}; expected a "
                f"time from {_text(self.times[0])} to {_text(self.times[-1])}, with transforms "
                f"{MAX_GAP:g} s apart at most",
                (self.times[0], self.times[-1]),
                utc,
            )
        before, after = (
            _transform(self, self.moments[index], self.times[index]) for index in (place - 1, place)
        )
        return before.between(after, _time(utc))


class TransformListener:
    """Receives transforms of a node's graph, from the first question on.

    Args:
        node: open node of ROS.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._links: dict[str, _FrameLink] = {}
        self._subscriptions: list[Any] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._news = asyncio.Event()
        self._timer: asyncio.TimerHandle | None = None
        self._full = False

    def listen(self) -> None:
        """Receive transforms until :data:`LINGER` seconds after the last question.

        Raises:
            RosError: the node is not open.
        """
        loop = asyncio.get_running_loop()
        if not self._subscriptions:
            for topic, qos in TOPICS.items():
                subscription = self._node.subscribe(topic, TYPE, qos=qos)
                self._subscriptions.append(subscription)
                task = loop.create_task(self._take(subscription, static=qos.latched))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
        if self._timer is not None:
            self._timer.cancel()
        self._timer = loop.call_later(LINGER, self._unsubscribe)

    def _unsubscribe(self) -> None:
        """Unsubscribe, and forget all transforms."""
        if self._timer is not None:
            self._timer.cancel()
        subscriptions, self._subscriptions, self._timer = self._subscriptions, [], None
        for subscription in subscriptions:
            subscription.close()
        for task in self._tasks:
            task.cancel()
        self._links.clear()

    async def close(self) -> None:
        """Unsubscribe. Idempotent."""
        self._unsubscribe()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _take(self, subscription: Any, *, static: bool) -> None:
        async for message in subscription:
            for transform in message.transforms:
                self._add(transform, static=static)
            self._news.set()

    def _add(self, message: Any, *, static: bool) -> None:
        child = message.child_frame_id.strip("/")
        parent = message.header.frame_id.strip("/")
        if not child or not parent or child == parent:
            return
        link = self._links.get(child)
        if link is None or link.parent != parent or (link.static is None) == static:
            if link is None and len(self._links) >= MAX_FRAMES:
                if not self._full:
                    logger.warning("TF: more than %s frames; %s is left out", MAX_FRAMES, child)
                self._full = True
                return
            link = self._links[child] = _FrameLink(child, parent)
        if static:
            link.static = message.transform
        else:
            link.add(utc_of(message.header), message.transform)

    # ------------------------------------------------------------------ questions

    async def pose(self, frame: str, base: str, utc: float | None = None) -> Transform:
        """Return the pose of a frame in another one, ``T_base_frame``.

        Args:
            frame: the frame.
            base: the frame of the returned pose.
            utc: time, seconds since 1970; None for the newest common time of all transforms.

        Raises:
            CalibrationError: ``WRONG_FRAME``: no way in TF; ``BAD_TIME``: no transform at that
                time, or the newest is old; ``NOT_RIGID``: a transform is not valid.
            RosError: the node is not open.
        """
        frame, base = frame.strip("/"), base.strip("/")
        return await self._until(lambda: self._pose(frame, base, utc))

    async def root(self, frame: str) -> str:
        """Return the root of the tree that a frame is in.

        Raises:
            CalibrationError: ``WRONG_FRAME``: TF does not know the frame.
        """

        def root_of_chain() -> str:
            chain = self._chain(frame.strip("/"))
            if not chain:
                raise self._unknown_frame_error(frame)
            return chain[-1].parent

        return await self._until(root_of_chain)

    async def _until(self, look: Callable[[], Found]) -> Found:
        """Return the result of ``look`` as soon as it succeeds; bounded."""
        self.listen()
        deadline = asyncio.get_running_loop().time() + WAIT
        while True:
            self._news.clear()
            try:
                return look()
            except CalibrationError:
                if asyncio.get_running_loop().time() >= deadline:
                    raise
            try:
                async with asyncio.timeout_at(deadline):
                    await self._news.wait()
            except TimeoutError:
                continue

    def _chain(self, frame: str) -> list[_FrameLink]:
        """Return the links from a frame up to its root."""
        links: list[_FrameLink] = []
        seen = {frame}
        while (link := self._links.get(frame)) is not None:
            links.append(link)
            frame = link.parent
            if frame in seen:
                raise Code.WRONG_FRAME.refusal(f"TF: {frame} is above itself; expected a tree")
            seen.add(frame)
        return links

    def _pose(self, frame: str, base: str, utc: float | None) -> Transform:
        up, down = self._chain(frame), self._chain(base)
        above = {frame, *(link.parent for link in up)}
        below = {base, *(link.parent for link in down)}
        shared = above & below
        if not shared:
            raise self._unknown_frame_error(frame if not up else base if not down else frame, base)
        up = _until_shared(up, frame, shared)
        down = _until_shared(down, base, shared)
        at = utc
        moving = [link for link in (*up, *down) if link.static is None]
        if at is None and moving:
            for link in moving:
                link.check_new()
            at = min(link.times[-1] for link in moving)
        lead = _product(up, frame, at)
        back = _product(down, base, at)
        transform = back.inverse() @ lead
        when = None if not moving or at is None else _time(at)
        return Transform(base, frame, transform.rotation, transform.translation, when)

    def _unknown_frame_error(self, frame: str, base: str = "") -> CalibrationError:
        known = sorted({*self._links, *(link.parent for link in self._links.values())})
        shown = ", ".join(known[:MAX_FRAMES_IN_ERROR]) or "no frame at all"
        to = f" to {base!r}" if base and base != frame else ""
        return Code.WRONG_FRAME.refusal(
            f"TF: no way leads from {frame!r}{to}; expected frames of one tree on /tf and "
            f"/tf_static, which have {shown}",
            known[:MAX_FRAMES_IN_ERROR],
            frame,
        )


def _until_shared(chain: list[_FrameLink], frame: str, shared: set[str]) -> list[_FrameLink]:
    """Return the links of a chain up to the first shared frame."""
    links: list[_FrameLink] = []
    for link in chain:
        if frame in shared:
            break
        links.append(link)
        frame = link.parent
    return links


def _product(chain: list[_FrameLink], frame: str, at: float | None) -> Transform:
    """Return the pose of a frame in the last parent of its chain."""
    transform = Transform(frame, frame, np.eye(3), np.zeros(3))
    for link in chain:
        transform = link.at(0.0 if at is None else at).undated() @ transform
    return transform


def _transform(link: _FrameLink, message: Any, utc: float | None) -> Transform:
    moved, turned = message.translation, message.rotation
    return Transform.from_quaternion(
        link.parent,
        link.child,
        (moved.x, moved.y, moved.z),
        (turned.x, turned.y, turned.z, turned.w),
        None if utc is None else _time(utc),
    )


def _time(utc: float) -> datetime:
    return datetime.fromtimestamp(utc, UTC)


def _text(utc: float) -> str:
    return _time(utc).isoformat(timespec="milliseconds")
