"""Receive ``/tf`` and ``/tf_static`` while programs ask for poses of frames, within bounds.

Poses are not extrapolated, except to 0.25 s before the first transform. A present pose is refused
if the newest transform on the way is old: a robot whose driver has died keeps its last pose in TF.
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

LINGER_TIME: Final = 60.0
"""Seconds for which transforms are received after the last request for a pose."""

TRANSFORM_TIMEOUT: Final = 3.0
"""Seconds to wait for transforms that are not known yet."""

MAX_AGE: Final = 2.0
"""Largest age of the newest transform of a moving frame, by its arrival and by its stamp."""

MAX_GAP: Final = 1.0
"""Largest number of seconds between two transforms between which poses are interpolated."""

MAX_EXTRAPOLATION_SECONDS: Final = 0.25
"""Seconds before the first received transform for which that transform is still used."""

MAX_STAMP_STEP_BACK: Final = 10.0
"""Largest age of a stamp against the newest one, seconds; an older one means a clock set back."""

MAX_FRAMES: Final = 2000
"""Largest number of known frames; further ones are left out, and the first is logged."""

MAX_TRANSFORMS_PER_FRAME: Final = 300
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
        times: times of the messages, UTC, in order.
        messages: messages of the transform at these times.
        arrived_at: time of the arrival of the newest message, by the monotonic clock.
    """

    child: str
    parent: str
    static: Any = None
    times: collections.deque[float] = field(
        default_factory=lambda: collections.deque[float](maxlen=MAX_TRANSFORMS_PER_FRAME)
    )
    messages: collections.deque[Any] = field(
        default_factory=lambda: collections.deque[Any](maxlen=MAX_TRANSFORMS_PER_FRAME)
    )
    arrived_at: float = 0.0

    def add(self, utc: float, message: Any) -> None:
        """Add the frame's transform at a time; ignore one that is older than the newest."""
        if self.times and utc < self.times[-1] - MAX_STAMP_STEP_BACK:  # the clock was set back
            self.times.clear()
            self.messages.clear()
        if not self.times or utc > self.times[-1]:
            self.times.append(utc)
            self.messages.append(message)
            self.arrived_at = time.monotonic()

    def check_recent(self) -> None:
        """Raise BAD_TIME if the newest transform is old."""
        silence, lag = time.monotonic() - self.arrived_at, time.time() - self.times[-1]
        if silence > MAX_AGE or abs(lag) > MAX_AGE:
            direction = "behind" if lag > 0 else "ahead of"
            raise Code.BAD_TIME.error(
                f"TF: {self.parent} -> {self.child}: the newest transform came {silence:.1f} s "
                f"ago, and its stamp is {abs(lag):.1f} s {direction} this computer's clock; "
                f"expected {MAX_AGE:g} s at most, from a robot that is running and clocks that "
                "agree",
                MAX_AGE,
                round(max(silence, abs(lag)), 3),
            )

    def transform_at(self, utc: float) -> Transform:
        """Return the transform at a time, interpolated.

        Raises:
            CalibrationError: BAD_TIME: no transform is known for that time; NOT_RIGID: the
                transform is not valid.
        """
        if self.static is not None:
            return _transform(self, self.static, None)
        after = bisect.bisect_left(self.times, utc)
        if after < len(self.times) and self.times[after] == utc:
            return _transform(self, self.messages[after], utc)
        if after == 0 and self.times[0] - utc <= MAX_EXTRAPOLATION_SECONDS:
            return _transform(self, self.messages[0], utc)
        if after in {0, len(self.times)} or self.times[after] - self.times[after - 1] > MAX_GAP:
            first, last = _time_text(self.times[0]), _time_text(self.times[-1])
            raise Code.BAD_TIME.error(
                f"TF: {self.parent} -> {self.child}: nothing is known of {_time_text(utc)}; "
                f"expected a time from {first} to {last}, with transforms "
                f"{MAX_GAP:g} s apart at most",
                (self.times[0], self.times[-1]),
                utc,
            )
        earlier, later = (
            _transform(self, self.messages[index], self.times[index])
            for index in (after - 1, after)
        )
        return earlier.between(later, _to_datetime(utc))


class TransformListener:
    """Receives TF's transforms at a node, beginning with the first request for a pose.

    Args:
        node: open node of ROS.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._links: dict[str, _FrameLink] = {}
        self._subscriptions: list[Any] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._has_news = asyncio.Event()
        self._timer: asyncio.TimerHandle | None = None
        self._is_full_logged = False

    def listen(self) -> None:
        """Receive transforms until :data:`LINGER_TIME` seconds after the last question.

        Raises:
            RosError: the node is not open.
        """
        loop = asyncio.get_running_loop()
        if not self._subscriptions:
            for topic, qos in TOPICS.items():
                subscription = self._node.subscribe(topic, TYPE, qos=qos)
                self._subscriptions.append(subscription)
                task = loop.create_task(self._receive(subscription, static=qos.latched))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
        if self._timer is not None:
            self._timer.cancel()
        self._timer = loop.call_later(LINGER_TIME, self._unsubscribe)

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

    async def _receive(self, subscription: Any, *, static: bool) -> None:
        async for message in subscription:
            for transform in message.transforms:
                self._add_transform(transform, static=static)
            self._has_news.set()

    def _add_transform(self, message: Any, *, static: bool) -> None:
        child = message.child_frame_id.strip("/")
        parent = message.header.frame_id.strip("/")
        if not child or not parent or child == parent:
            return
        link = self._links.get(child)
        if link is None or link.parent != parent or (link.static is None) == static:
            if link is None and len(self._links) >= MAX_FRAMES:
                if not self._is_full_logged:
                    logger.warning("TF: more than %s frames; %s is left out", MAX_FRAMES, child)
                self._is_full_logged = True
                return
            link = self._links[child] = _FrameLink(child, parent)
        if static:
            link.static = message.transform
        else:
            link.add(utc_of(message.header), message.transform)

    # ------------------------------------------------------------------ requests

    async def pose(self, frame: str, base: str, utc: float | None = None) -> Transform:
        """Return the pose of a frame in another one, ``T_base_frame``.

        Args:
            frame: the frame.
            base: the frame of the returned pose.
            utc: time, seconds since 1970; None for the newest common time of all transforms.

        Raises:
            CalibrationError: ``WRONG_FRAME``: TF does not connect the frames; ``BAD_TIME``: no
                transform at that time, or the newest is old; ``NOT_RIGID``: a transform is not
                valid.
            RosError: the node is not open.
        """
        frame, base = frame.strip("/"), base.strip("/")
        return await self._retry_until_found(lambda: self._find_pose(frame, base, utc))

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

        return await self._retry_until_found(root_of_chain)

    async def _retry_until_found(self, find: Callable[[], Found]) -> Found:
        """Call ``find`` until it succeeds, or until the timeout; return its result."""
        self.listen()
        deadline = asyncio.get_running_loop().time() + TRANSFORM_TIMEOUT
        while True:
            self._has_news.clear()
            try:
                return find()
            except CalibrationError:
                if asyncio.get_running_loop().time() >= deadline:
                    raise
            try:
                async with asyncio.timeout_at(deadline):
                    await self._has_news.wait()
            except TimeoutError:
                continue

    def _chain(self, frame: str) -> list[_FrameLink]:
        """Return the links from a frame up to its root."""
        links: list[_FrameLink] = []
        visited = {frame}
        while (link := self._links.get(frame)) is not None:
            links.append(link)
            frame = link.parent
            if frame in visited:
                raise Code.WRONG_FRAME.error(f"TF: {frame} is above itself; expected a tree")
            visited.add(frame)
        return links

    def _find_pose(self, frame: str, base: str, utc: float | None) -> Transform:
        frame_links, base_links = self._chain(frame), self._chain(base)
        frame_ancestors = {frame, *(link.parent for link in frame_links)}
        base_ancestors = {base, *(link.parent for link in base_links)}
        shared = frame_ancestors & base_ancestors
        if not shared:
            raise self._unknown_frame_error(
                frame if not frame_links else base if not base_links else frame, base
            )
        frame_links = _cut_at_shared(frame_links, frame, shared)
        base_links = _cut_at_shared(base_links, base, shared)
        transform_at = utc
        moving = [link for link in (*frame_links, *base_links) if link.static is None]
        if transform_at is None and moving:
            for link in moving:
                link.check_recent()
            transform_at = min(link.times[-1] for link in moving)
        frame_pose = _product(frame_links, frame, transform_at)
        base_pose = _product(base_links, base, transform_at)
        transform = base_pose.inverse() @ frame_pose
        stamp = None if not moving or transform_at is None else _to_datetime(transform_at)
        return Transform(base, frame, transform.rotation, transform.translation, stamp)

    def _unknown_frame_error(self, frame: str, base: str = "") -> CalibrationError:
        known_frames = sorted({*self._links, *(link.parent for link in self._links.values())})
        known_text = ", ".join(known_frames[:MAX_FRAMES_IN_ERROR]) or "no frame at all"
        to = f" to {base!r}" if base and base != frame else ""
        return Code.WRONG_FRAME.error(
            f"TF: no way leads from {frame!r}{to}; expected frames of one tree on /tf and "
            f"/tf_static, which have {known_text}",
            known_frames[:MAX_FRAMES_IN_ERROR],
            frame,
        )


def _cut_at_shared(chain: list[_FrameLink], frame: str, shared: set[str]) -> list[_FrameLink]:
    """Return the links of a chain up to the first shared frame."""
    links: list[_FrameLink] = []
    for link in chain:
        if frame in shared:
            break
        links.append(link)
        frame = link.parent
    return links


def _product(chain: list[_FrameLink], frame: str, transform_at: float | None) -> Transform:
    """Return the pose of a frame in the last parent of its chain."""
    transform = Transform(frame, frame, np.eye(3), np.zeros(3))
    for link in chain:
        transform = (
            link.transform_at(0.0 if transform_at is None else transform_at).undated() @ transform
        )
    return transform


def _transform(link: _FrameLink, message: Any, utc: float | None) -> Transform:
    translation, rotation = message.translation, message.rotation
    return Transform.from_quaternion(
        link.parent,
        link.child,
        (translation.x, translation.y, translation.z),
        (rotation.x, rotation.y, rotation.z, rotation.w),
        None if utc is None else _to_datetime(utc),
    )


def _to_datetime(utc: float) -> datetime:
    return datetime.fromtimestamp(utc, UTC)


def _time_text(utc: float) -> str:
    return _to_datetime(utc).isoformat(timespec="milliseconds")
