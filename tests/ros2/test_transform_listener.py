"""Trees of frames, their times, and refused transforms, from generated messages."""

from __future__ import annotations

import asyncio
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from smartcam.exceptions import CalibrationError
from smartcam.ros2 import Node, QoS, RosTypes
from smartcam.ros2._cameras import transform_listener
from smartcam.ros2._cameras.transform_listener import (
    MAX_FRAMES,
    MAX_TRANSFORMS_PER_FRAME,
    TransformListener,
)
from tests.fleet.fleetkit import until
from tests.processes import free_place

KIND = RosTypes().message("tf2_msgs/msg/TFMessage")


class Heard:
    """A subscription on paper."""

    def __init__(self) -> None:
        self.queue: asyncio.Queue[Any] = asyncio.Queue()
        self.closed = False

    def __aiter__(self) -> Heard:
        return self

    async def __anext__(self) -> Any:
        return await self.queue.get()

    def close(self) -> None:
        self.closed = True


class Paper:
    """A node on paper, whose transforms a test says."""

    def __init__(self) -> None:
        self.heard: dict[str, Heard] = {}

    def subscribe(self, topic: str, type: str, *, qos: QoS) -> Heard:
        assert type == "tf2_msgs/msg/TFMessage"
        assert qos.latched == (topic == "/tf_static")
        made = self.heard[topic] = Heard()
        return made

    def say(self, parent: str, child: str, x: float = 0.0, **more: Any) -> None:
        """Say a transform: ``utc`` is its time, ``turn`` an angle about z, ``static`` its kind."""
        fields = {"transforms": [moved(parent, child, x, **more)]}
        topic = "/tf_static" if more.get("static") else "/tf"
        self.heard[topic].queue.put_nowait(KIND.decode(KIND.encode(fields)))


def moved(
    parent: str,
    child: str,
    x: float,
    *,
    utc: float | None = None,
    turn: float = 0.0,
    static: bool = False,
) -> dict[str, Any]:
    when = time.time() if utc is None else utc
    stamp = {"sec": int(when), "nanosec": int(when % 1 * 1e9)}
    quaternion = {"z": float(np.sin(turn / 2)), "w": float(np.cos(turn / 2))}
    return {
        "header": {"stamp": stamp, "frame_id": parent},
        "child_frame_id": child,
        "transform": {"translation": {"x": x}, "rotation": quaternion},
    }


@pytest.fixture
def paper() -> Paper:
    return Paper()


@pytest.fixture
async def listener(paper: Paper, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(transform_listener, "TRANSFORM_TIMEOUT", 0.05)
    made = TransformListener(paper)
    made.listen()
    yield made
    await made.close()


async def refused(asked: Any) -> CalibrationError:
    with pytest.raises(CalibrationError) as caught:
        await asked
    return caught.value


# ---------------------------------------------------------------------- trees


async def test_a_way_leads_up_and_down_a_tree(paper: Paper, listener: TransformListener) -> None:
    paper.say("world", "base", 1.0, static=True)
    paper.say("base", "arm", 10.0, turn=np.pi / 2)
    paper.say("arm", "tool", 100.0)
    paper.say("/world", "/table", 1000.0, static=True)  # as tf of ROS 1 writes it
    found = await listener.pose("tool", "base")
    assert (found.target, found.source) == ("base", "tool")
    assert np.allclose(found.translation, [10.0, 100.0, 0.0])
    assert found.at is not None
    found = await listener.pose("tool", "table")
    assert np.allclose(found.translation, [-989.0, 100.0, 0.0])
    back = await listener.pose("table", "tool")
    assert np.allclose((found @ back).translation, 0.0)
    assert np.allclose((found @ back).rotation, np.eye(3))
    assert (await listener.pose("table", "world")).at is None  # nothing on the way moves
    assert np.allclose((await listener.pose("tool", "tool")).translation, 0.0)
    assert await listener.root("tool") == "world"


async def test_what_leads_nowhere_is_refused(paper: Paper, listener: TransformListener) -> None:
    error = await refused(listener.pose("tool", "base"))
    assert error.code == "WRONG_FRAME"
    assert "no frame at all" in str(error)
    paper.say("world", "base", static=True)
    paper.say("moon", "rover", static=True)
    error = await refused(listener.pose("rover", "base"))
    assert "from 'rover' to 'base'" in str(error)
    assert "base, moon, rover, world" in str(error)
    assert (await refused(listener.root("world"))).code == "WRONG_FRAME"
    for parent, child in (("", "x"), ("x", ""), ("x", "x")):  # no frames
        paper.say(parent, child, static=True)
    paper.say("b", "a")
    paper.say("a", "b")
    assert "is above itself" in str(await refused(listener.pose("a", "base")))


async def test_a_quaternion_that_is_none_is_refused(
    paper: Paper, listener: TransformListener
) -> None:
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="base"),
        child_frame_id="tool",
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=0.0, y=0.0, z=0.0),
            rotation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0),
        ),
    )
    paper.heard["/tf_static"].queue.put_nowait(SimpleNamespace(transforms=[message]))
    assert (await refused(listener.pose("tool", "base"))).code == "NOT_RIGID"


async def test_a_frame_may_get_another_parent(paper: Paper, listener: TransformListener) -> None:
    paper.say("left", "part", 1.0, static=True)
    assert await listener.root("part") == "left"
    paper.say("right", "part", 2.0)
    await until(lambda: listener._links["part"].parent == "right")
    assert np.allclose((await listener.pose("part", "right")).translation, [2.0, 0.0, 0.0])


# ---------------------------------------------------------------------- times


async def test_a_pose_in_between_is_interpolated(paper: Paper, listener: TransformListener) -> None:
    now = time.time()
    for past, x, turn in ((0.5, 0.0, 0.0), (0.1, 4.0, 1.0)):
        paper.say("base", "tool", x, utc=now - past, turn=turn)
    found = await listener.pose("tool", "base", now - 0.4)
    assert np.allclose(found.translation, [1.0, 0.0, 0.0], atol=1e-5)
    assert np.arctan2(found.rotation[1, 0], found.rotation[0, 0]) == pytest.approx(0.25, abs=1e-5)
    early = await listener.pose("tool", "base", now - 0.6)  # just before the first that was heard
    assert np.allclose(early.translation, 0.0)
    for utc in (now - 0.8, now):
        error = await refused(listener.pose("tool", "base", utc))
        assert error.code == "BAD_TIME"
        assert "nothing is known of" in str(error)


async def test_nothing_is_interpolated_over_a_gap(
    paper: Paper, listener: TransformListener
) -> None:
    now = time.time()
    for past in (1.6, 0.1):
        paper.say("base", "tool", past, utc=now - past)
    assert (await refused(listener.pose("tool", "base", now - 0.5))).code == "BAD_TIME"


async def test_what_all_are_known_at_is_the_newest(
    paper: Paper, listener: TransformListener
) -> None:
    now = time.time()
    paper.say("base", "arm", 0.0, utc=now - 0.5)
    paper.say("base", "arm", 10.0, utc=now)
    paper.say("arm", "tool", 0.0, utc=now - 0.25)
    found = await listener.pose("tool", "base")
    assert np.allclose(found.translation, [5.0, 0.0, 0.0], atol=1e-4)
    assert found.at is not None
    assert found.at.timestamp() == pytest.approx(now - 0.25, abs=1e-5)


@pytest.mark.parametrize(("ahead", "way"), [(-5.0, "behind"), (5.0, "ahead of")])
async def test_a_stamp_that_is_old_is_refused(
    paper: Paper, listener: TransformListener, ahead: float, way: str
) -> None:
    paper.say("base", "tool", utc=time.time() + ahead)
    error = await refused(listener.pose("tool", "base"))
    assert error.code == "BAD_TIME"
    assert f"s {way} this computer's clock" in str(error)


@pytest.mark.real_time
async def test_a_robot_that_says_no_more_is_refused(
    paper: Paper, listener: TransformListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transform_listener, "MAX_AGE", 0.2)
    stamp = time.time()
    paper.say("base", "tool", 1.0, utc=stamp)
    assert (await listener.pose("tool", "base")).translation[0] == 1.0
    await asyncio.sleep(0.25)
    assert (await refused(listener.pose("tool", "base"))).code == "BAD_TIME"
    paper.say("base", "tool", 1.0, utc=stamp)  # said again, which is no news
    assert (await refused(listener.pose("tool", "base"))).code == "BAD_TIME"
    paper.say("base", "tool", 2.0)
    assert (await listener.pose("tool", "base")).translation[0] == 2.0


async def test_what_is_not_known_yet_is_waited_for(
    paper: Paper, listener: TransformListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transform_listener, "TRANSFORM_TIMEOUT", 5.0)
    asked = asyncio.create_task(listener.pose("tool", "base"))
    await asyncio.sleep(0.05)
    paper.say("base", "tool", 3.0)
    assert (await asyncio.wait_for(asked, 2)).translation[0] == 3.0


async def test_a_clock_that_was_set_back_begins_anew(
    paper: Paper, listener: TransformListener
) -> None:
    paper.say("base", "tool", 1.0, utc=time.time() + 100.0)
    paper.say("base", "tool", 2.0)
    assert (await listener.pose("tool", "base")).translation[0] == 2.0


# ---------------------------------------------------------------------- bounds


async def test_frames_and_moments_are_bounded(paper: Paper, listener: TransformListener) -> None:
    now = time.time()
    for number in range(MAX_FRAMES + 50):
        listener._add_transform(as_message("base", f"f{number}", now), static=True)
    for number in range(2 * MAX_TRANSFORMS_PER_FRAME):
        listener._add_transform(as_message("base", "f1", now + 1e-3 * number), static=False)
    assert len(listener._links) == MAX_FRAMES
    assert len(listener._links["f1"].times) == MAX_TRANSFORMS_PER_FRAME


def as_message(parent: str, child: str, utc: float) -> Any:
    fields = {"transforms": [moved(parent, child, 0.0, utc=utc)]}
    (one,) = KIND.decode(KIND.encode(fields)).transforms
    return one


async def test_nothing_is_heard_after_a_while_without_questions(
    paper: Paper, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transform_listener, "LINGER_TIME", 0.1)
    made = TransformListener(paper)
    assert not paper.heard
    made.listen()
    first = paper.heard["/tf"]
    await asyncio.sleep(0.3)
    assert first.closed
    made.listen()
    assert paper.heard["/tf"] is not first
    assert len(made._tasks) == 2
    await made.close()
    assert paper.heard["/tf"].closed


@pytest.mark.real_time
async def test_static_frames_of_a_real_graph_are_heard_by_who_comes_later() -> None:
    place = free_place()
    async with Node("robot", listen=place) as robot, Node("camera", connect=place) as camera:
        stands = robot.publisher("/tf_static", KIND.name, qos=QoS(latched=True, depth=1))
        stands.publish(transforms=[moved("world", "base", 7.0)])
        listener = TransformListener(camera)
        try:
            assert (await listener.pose("base", "world")).translation[0] == 7.0
        finally:
            await listener.close()
