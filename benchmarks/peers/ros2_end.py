"""An end of ROS 2 in a process of its own.

``python -m benchmarks.peers.ros2_end KIND PORT FOLDER``: KIND is ``smartcam``, ``sdk``
(zenoh-ros2-sdk) or ``zenoh`` (bare, with bytes that are ready). It does what the lines of JSON on
its standard input say, and answers each by one. The end with a
source or a server of smartcam or of bare Zenoh is the router at PORT; those of the SDK, which
cannot be one, meet at smartcam's. FOLDER is where the SDK finds its message definitions.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.control import resident
from smartcam._zenoh import RUNTIME

__all__ = ["HEIGHT", "WIDTH", "pictures"]

WIDTH, HEIGHT = 1280, 1024
IMAGE, SET_BOOL, DETECTIONS = (
    "sensor_msgs/msg/Image",
    "std_srvs/srv/SetBool",
    "vision_msgs/msg/Detection3DArray",
)
TOPIC, SERVICE = "/bench/image_raw", "/bench/set"
DOMAIN = 7
UNDER_WAY = 2
"""Pictures that are on their way at once."""

LIMIT = 30.0
"""Seconds until a message that does not come is an error."""

PATIENCE = 2.0
"""Seconds until another picture is asked for, of who may lose some."""

DEFINITIONS = {
    "rcl_interfaces/builtin_interfaces/msg/Time.msg": "int32 sec\nuint32 nanosec\n",
    "common_interfaces/std_msgs/msg/Header.msg": (
        "builtin_interfaces/Time stamp\nstring frame_id\n"
    ),
    "common_interfaces/sensor_msgs/msg/Image.msg": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data\n"
    ),
}
SET_BOOL_TEXTS = ("bool data", "bool success\nstring message")


def pictures() -> list[Any]:
    """Return the data of four pictures that differ, rows one after the other."""
    numbers = np.random.default_rng(1)
    return [numbers.integers(0, 256, WIDTH * HEIGHT, np.uint8) for _ in range(4)]


class Sink:
    """Checks what comes, and asks for as many pictures more over TCP: a byte is one.

    Args:
        port: of the source.
        may_lose: one that does not come is no error; it is asked for another one then.
    """

    def __init__(self, port: int, *, may_lose: bool = False) -> None:
        self._asking = socket.create_connection(("127.0.0.1", port))
        self._asking.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._expected = [one.view(np.uint64) for one in pictures()]
        self._may_lose = may_lose
        self._number = self._missing = self._to_ask = 0
        self.came = threading.Event()

    def begin(self, count: int) -> None:
        """Ask for the first ones."""
        self.came.clear()
        first = min(UNDER_WAY, count)
        self._missing, self._to_ask = count, count - first
        self.ask(first)

    def ask(self, count: int = 1) -> None:
        """Ask for so many."""
        self._asking.sendall(bytes(count))

    def take(self, number: int, data: Any) -> None:
        """Take one, which has to be whole, and the next one."""
        expected = self._expected[number % len(self._expected)]
        whole = np.array_equal(np.frombuffer(data, np.uint64), expected)
        if not whole or (number != self._number and not self._may_lose):
            print(f"{sys.argv[1]}: picture {number}, expected {self._number}", file=sys.stderr)
            os._exit(1)
        self._number = number + 1
        if self._to_ask:
            self._to_ask -= 1
            self.ask()
        self._missing -= 1
        if not self._missing:
            self.came.set()


def _listen(publish: Any) -> int:
    """Publish a picture for each byte that comes, in a thread; return the port."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        client, number = server.accept()[0], 0
        while asked := client.recv(64):
            for _ in asked:
                publish(number)
                number += 1

    threading.Thread(target=serve, daemon=True).start()
    port: int = server.getsockname()[1]
    return port


def _timed(call: Any, count: int) -> list[float]:
    took: list[float] = []
    for _ in range(count):
        begin = time.perf_counter()
        call()
        took.append(time.perf_counter() - begin)
    return took


class End:
    """What all of them can do."""

    def usage(self) -> tuple[float, float]:
        """Return seconds of CPU time up to now, and KiB of memory."""
        return time.process_time(), resident()


class SdkEnd(End):
    """Those of zenoh-ros2-sdk, which call back in threads of the engine's."""

    def __init__(self, port: int, folder: Path) -> None:
        write_definitions(folder)
        os.environ |= {"ZENOH_ROS2_SDK_CACHE": str(folder), "HOME": str(folder)}
        self._place: dict[str, Any] = {"router_port": port, "domain_id": DOMAIN + 1}
        self._kept: list[Any] = []

    def source(self) -> int:
        """Publish pictures for whoever connects to the port that is returned."""
        from zenoh_ros2_sdk import ROS2Publisher

        publisher = ROS2Publisher(TOPIC, IMAGE, **self._place)
        types = publisher.session_mgr.store.types
        header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
        data = pictures()

        def publish(number: int) -> None:
            publisher.publish(
                header=header(stamp=stamp(sec=number, nanosec=0), frame_id="bench"),
                height=HEIGHT,
                width=WIDTH,
                encoding="mono8",
                is_bigendian=0,
                step=WIDTH,
                data=data[number % len(data)],
            )

        self._kept.append(publisher)
        return _listen(publish)

    def sink(self, port: int) -> None:
        """Hear the pictures of a source."""
        from zenoh_ros2_sdk import ROS2Subscriber

        self._sink = sink = Sink(port, may_lose=True)

        def hear(message: Any) -> None:
            sink.take(message.header.stamp.sec, message.data)

        self._kept.append(ROS2Subscriber(TOPIC, IMAGE, hear, **self._place))

    def take(self, count: int) -> float:
        """Have so many pictures come; return the seconds that it took."""
        begin = time.perf_counter()
        self._sink.begin(count)
        while not self._sink.came.wait(PATIENCE):
            if time.perf_counter() > begin + LIMIT:
                raise TimeoutError("a picture did not come")
            self._sink.ask()
        return time.perf_counter() - begin

    def serve(self) -> None:
        """Serve a SetBool."""
        from zenoh_ros2_sdk import ROS2ServiceServer

        def answer(request: Any) -> Any:
            return server.response_msg_class(success=request.data, message="as asked")

        texts = dict(
            zip(("request_definition", "response_definition"), SET_BOOL_TEXTS, strict=True)
        )
        server = ROS2ServiceServer(SERVICE, SET_BOOL, answer, **texts, **self._place)
        self._kept.append(server)

    def client(self) -> None:
        """Be the client of a server."""
        from zenoh_ros2_sdk import ROS2ServiceClient

        self._client = ROS2ServiceClient(SERVICE, SET_BOOL, *SET_BOOL_TEXTS, **self._place)

    def call(self, count: int) -> list[float]:
        """Call so often; return the seconds of each."""

        def call() -> None:
            reply: Any = self._client.call(data=True)
            assert reply.success, reply

        return _timed(call, count)


class ZenohEnd(End):
    """Bare Zenoh: the same bytes, which are ready, and nothing is made of them."""

    def __init__(self, port: int, folder: Path) -> None:
        self._port = port
        self._session: Any = None
        self._kept: list[Any] = []
        from smartcam.ros2._types.types import RosTypes

        types = RosTypes()
        image, service = types.message(IMAGE), types.service(SET_BOOL)
        self._image = image
        self._request = service.request.encode({"data": True})
        self._reply = service.response.encode({"success": True, "message": "as asked"})

    def _open(self, *, listen: bool) -> Any:
        if self._session is not None:
            return self._session
        import zenoh

        place = [f"tcp/127.0.0.1:{self._port}"]
        config = zenoh.Config()
        for path, value in {
            "mode": "router" if listen else "client",
            "listen/endpoints": place if listen else [],
            "connect/endpoints": [] if listen else place,
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,
        }.items():
            config.insert_json5(path, json.dumps(value))
        self._session = zenoh.open(config)
        return self._session

    def _direct(self, call: Any) -> Any:
        import zenoh

        return zenoh.handlers.Callback(call, indirect=False)

    def source(self) -> int:
        """Publish pictures for whoever connects to the port that is returned."""
        import zenoh

        publisher = self._open(listen=True).declare_publisher(
            "bench/image", congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )
        self._kept.append(publisher)
        ready = [self._image.encode(fields_of(0, one)) for one in pictures()]

        def publish(number: int) -> None:
            publisher.put(ready[number % len(ready)], attachment=number.to_bytes(33, "little"))

        return _listen(publish)

    def sink(self, port: int) -> None:
        """Hear the pictures of a source."""
        self._sink = sink = Sink(port)
        size = WIDTH * HEIGHT

        def hear(sample: Any) -> None:
            data = sample.payload.to_bytes()
            number = int.from_bytes(sample.attachment.to_bytes(), "little")
            sink.take(number, memoryview(data)[len(data) - size :])

        session = self._open(listen=False)
        self._kept.append(session.declare_subscriber("bench/image", self._direct(hear)))

    take = SdkEnd.take

    def serve(self) -> None:
        """Answer queries."""
        reply = self._reply

        def answer(query: Any) -> None:
            query.payload.to_bytes()
            query.reply("bench/set", reply, express=True)
            query.drop()

        queryable = self._open(listen=True).declare_queryable(
            "bench/set", self._direct(answer), complete=True
        )
        self._kept.append(queryable)

    def client(self) -> None:
        """Ask queries."""
        import zenoh

        self._querier = self._open(listen=False).declare_querier(
            "bench/set",
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            express=True,
        )

    def call(self, count: int) -> list[float]:
        """Ask so often; return the seconds of each."""
        came = threading.Event()
        found: list[bytes] = []

        def hear(reply: Any) -> None:
            found.append(reply.ok.payload.to_bytes())
            came.set()

        def call() -> None:
            came.clear()
            self._querier.get(self._direct(hear), payload=self._request, attachment=bytes(33))
            if not came.wait(LIMIT) or found.pop() != self._reply:
                raise TimeoutError("no reply came")

        return _timed(call, count)


def fields_of(number: int, data: Any) -> dict[str, Any]:
    """Return the fields of a picture."""
    return {
        "header": {"stamp": {"sec": number, "nanosec": 0}, "frame_id": "bench"},
        "height": HEIGHT,
        "width": WIDTH,
        "encoding": "mono8",
        "step": WIDTH,
        "data": data,
    }


class SmartcamEnd(End):
    """Ours."""

    def __init__(self, port: int, folder: Path) -> None:
        self._place = f"tcp/127.0.0.1:{port}"
        self._node: Any = None
        self._kept: list[Any] = []

    async def _open(self, *, listen: bool) -> Any:
        from smartcam.ros2 import Node

        if self._node is None:
            how: Any = {"listen": self._place} if listen else {"connect": self._place}
            self._node = Node("here" if listen else "there", domain=DOMAIN, **how)
            await self._node.start()
        return self._node

    async def source(self) -> int:
        """Publish pictures for whoever connects to the port that is returned."""
        publisher = (await self._open(listen=True)).publisher(TOPIC, IMAGE)
        data = pictures()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            number = 0
            while asked := await reader.read(64):
                for _ in asked:
                    publisher.publish(fields_of(number, data[number % len(data)]))
                    number += 1
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1")
        self._kept.append(server)
        port: int = server.sockets[0].getsockname()[1]
        return port

    async def sink(self, port: int) -> None:
        """Hear the pictures of a source."""
        self._sink = Sink(port)
        self._pictures = (await self._open(listen=False)).subscribe(TOPIC, IMAGE)

    async def take(self, count: int) -> float:
        """Have so many pictures come; return the seconds that it took."""
        begin = time.perf_counter()
        self._sink.begin(count)
        async with asyncio.timeout(LIMIT):
            async for message in self._pictures:
                self._sink.take(message.header.stamp.sec, message.data)
                if self._sink.came.is_set():
                    break
        return time.perf_counter() - begin

    async def serve(self) -> None:
        """Serve a SetBool."""

        async def answer(request: Any) -> Any:
            return {"success": request.data, "message": "as asked"}

        (await self._open(listen=True)).serve(SERVICE, SET_BOOL, answer)

    async def client(self) -> None:
        """Be the client of a server."""
        self._client = (await self._open(listen=False)).client(SERVICE, SET_BOOL)
        await self._client.wait_served(LIMIT)

    async def call(self, count: int) -> list[float]:
        """Call so often; return the seconds of each."""
        took: list[float] = []
        for _ in range(count):
            begin = time.perf_counter()
            reply = await self._client.call(data=True)
            took.append(time.perf_counter() - begin)
            assert reply.success
        return took

    async def hear(self, topic: str, kind: str) -> None:
        """Hear a topic, and leave what comes."""
        self._heard = (await self._open(listen=False)).subscribe(topic, kind)

    def heard(self) -> int:
        """Return how many messages came there."""
        return int(self._heard.statistics().offered)


def write_definitions(folder: Path) -> None:
    """Write the git repositories that the SDK looks for."""
    for name, text in DEFINITIONS.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    git = shutil.which("git") or "git"
    who = ("-c", "user.name=bench", "-c", "user.email=bench@localhost")
    for repository in {Path(name).parts[0] for name in DEFINITIONS}:
        if not (folder / repository / ".git").exists():
            for command in (("init", "-q", "-b", "jazzy"), ("add", "."), ("commit", "-qm", "it")):
                subprocess.run([git, *who, *command], cwd=folder / repository, check=True)


KINDS = {"smartcam": SmartcamEnd, "sdk": SdkEnd, "zenoh": ZenohEnd}


async def main() -> None:
    """Do what the lines of standard input say, one after the other."""
    if sys.argv[1] != "sdk":
        os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what it prints is not an answer
    end: Any = KINDS[sys.argv[1]](int(sys.argv[2]), Path(sys.argv[3]))
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(lines), sys.stdin
    )
    while line := await lines.readline():
        told = json.loads(line)
        found = getattr(end, told.pop("do"))(**told)
        if asyncio.iscoroutine(found):
            found = await found
        print(json.dumps(found), file=out, flush=True)
    os._exit(0)  # threads of the engine and the SDK do not end


if __name__ == "__main__":
    asyncio.run(main())
