"""smartcam, a rosbridge and a program of ROS 1; run in a network namespace, by test_rospy.py.

``python -m tests.ros1.in_namespace FOLDER [BRIDGE'S COMMAND]`` prints what was seen, as JSON. The
bridge's command gets its port as its last argument; without one it is bridge_server.py.
"""

import asyncio
import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Self

import numpy as np

import smartcam
from smartcam.ros1 import RosbridgeNode
from smartcam.ros2 import QoS

ROOT = Path(__file__).parents[2]
PYTHON = "/usr/bin/python3"
MASTER, BRIDGE, PROXY = 11311, 9090, 9091
MESSAGES = ROOT / "ros2" / "smartcam_msgs"
FLEET = """\
calibrations: calibrations
cameras:
  line1/cam3: {emulated: {}, application: 7, interpret_as: localizations}
  cam4: {emulated: {}, application: 7, interpret_as: localizations}
"""
TRIGGER, EMPTY = "std_srvs/Trigger", "std_srvs/Empty"
LOCALIZE = "smartcam_msgs/TriggerLocalization"
PICTURE = np.random.default_rng(1).integers(0, 256, 640 * 480, np.uint8).tobytes()


def generate(folder: Path) -> None:
    """Have Debian's genpy make Python of smartcam_msgs."""
    package = folder / "smartcam_msgs"
    include = [f"-Ismartcam_msgs:{MESSAGES}/msg"]
    include += [f"-I{one}:/usr/share/{one}/msg" for one in ("std_msgs", "geometry_msgs")]
    for kind in ("msg", "srv"):
        (package / kind).mkdir(parents=True)
        (package / "__init__.py").touch()
        program = [PYTHON, f"/usr/lib/genpy/gen{kind}_py.py", "-p", "smartcam_msgs"]
        target = ["-o", str(package / kind)]
        # what has pictures wants sensor_msgs, which need not be there
        files = [
            str(one)
            for one in (MESSAGES / kind).iterdir()
            if "sensor_msgs/" not in one.read_text(encoding="utf-8")
        ]
        for more in ([*include, *target, *files], [*target, "--initpy"]):
            subprocess.run([*program, *more], check=True, capture_output=True)  # noqa: S603


def generate_transforms(folder: Path) -> None:
    """Have Debian's genpy make Python of tf2_msgs/TFMessage, which is in a package of its own."""
    source, package = folder / "TFMessage.msg", folder / "tf2_msgs"
    source.write_text("geometry_msgs/TransformStamped[] transforms\n")
    (package / "msg").mkdir(parents=True)
    (package / "__init__.py").touch()
    program = [PYTHON, "/usr/lib/genpy/genmsg_py.py", "-p", "tf2_msgs", "-o", str(package / "msg")]
    include = [f"-I{one}:/usr/share/{one}/msg" for one in ("std_msgs", "geometry_msgs")]
    for more in ([*include, str(source)], ["--initpy"]):
        subprocess.run([*program, *more], check=True, capture_output=True)  # noqa: S603


class Program:
    """A process; what it says on stderr is in a file of its name."""

    def __init__(self, folder: Path, name: str, *command: str) -> None:
        self.log, self._command = folder / f"{name}.log", command
        self._answers: dict[int, asyncio.Future[Any]] = {}
        self.lines: asyncio.Queue[str] = asyncio.Queue()

    async def __aenter__(self) -> Self:
        with self.log.open("a") as log:
            self.process = await asyncio.create_subprocess_exec(
                *self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log,
                limit=1 << 24,
            )  # fmt: skip
        self._reading = asyncio.create_task(self._read())
        return self

    async def __aexit__(self, *_: object) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        await self.process.wait()
        await self._reading

    async def _read(self) -> None:
        assert self.process.stdout is not None
        async for line in self.process.stdout:
            text = line.decode()
            said = json.loads(text) if text.startswith("{") else {}
            answer = self._answers.pop(said.get("id", -1), None)
            if answer is None:
                self.lines.put_nowait(text)
            else:
                answer.set_result(said)

    def ask(self, do: str, *given: Any) -> asyncio.Future[Any]:
        """Have a line done; the answer's ``ok``, or its error's text."""
        number = len(self._answers) + id(given)
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        assert self.process.stdin is not None
        line = json.dumps({"id": number, "do": do, "with": given})
        self.process.stdin.write(f"{line}\n".encode())
        return asyncio.ensure_future(self._ok(answer))

    async def _ok(self, answer: asyncio.Future[Any]) -> Any:
        said = await answer
        return said["error"] if "error" in said else said["ok"]


class Proxy:
    """The network on the way to the bridge."""

    def __init__(self) -> None:
        self._links: set[asyncio.StreamWriter] = set()

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._carry, "127.0.0.1", PROXY)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        self.cut()

    def cut(self) -> None:
        for link in tuple(self._links):
            link.transport.abort()

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            to, back = await asyncio.open_connection("127.0.0.1", BRIDGE)
        except OSError:
            writer.transport.abort()
            return
        self._links |= {writer, back}
        with contextlib.suppress(OSError):
            await asyncio.gather(self._pipe(reader, back), self._pipe(to, writer))
        self._links -= {writer, back}

    async def _pipe(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(1 << 16):
                writer.write(data)
                await writer.drain()
        finally:
            writer.transport.abort()


async def listening(port: int) -> None:
    """Wait until somebody listens."""
    async with asyncio.timeout(60):
        while True:
            with contextlib.suppress(OSError):
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.close()
                return
            await asyncio.sleep(0.05)


@contextlib.asynccontextmanager
async def bridge_of(folder: Path, command: list[str]) -> AsyncIterator[Program]:
    async with Program(folder, "bridge", *command, str(BRIDGE)) as bridge:
        await listening(BRIDGE)
        yield bridge


# ---------------------------------------------------------------------- what is looked at


async def topics(node: RosbridgeNode, peer: Program) -> dict[str, Any]:
    """Return what rospy hears."""
    text = node.publisher("~/text", "std_msgs/msg/String", qos=QoS(latched=True, depth=1))
    info = node.publisher("~/info", "sensor_msgs/msg/CameraInfo", qos=QoS(latched=True, depth=1))
    image = node.publisher("~/image", "sensor_msgs/msg/Image", qos=QoS(depth=1))
    stamp = {"sec": 1_700_000_000, "nanosec": 5}
    text.publish(data="grün")
    info.publish(header={"stamp": stamp, "frame_id": "f"}, k=np.arange(9.0), d=[0.5], width=640)
    found = {
        "text": await peer.ask("get", text.name, "std_msgs/String"),
        "info": await peer.ask("get", info.name, "sensor_msgs/CameraInfo"),
    }
    picture = peer.ask("get", image.name, "sensor_msgs/Image")
    while not picture.done():
        image.publish(height=480, width=640, encoding="mono8", step=640, data=PICTURE)
        await asyncio.sleep(0.05)
    expected = [len(PICTURE), hashlib.sha256(PICTURE).hexdigest()]
    return {**found, "picture": (await picture)["data"] == expected}


async def services(node: RosbridgeNode, peer: Program) -> dict[str, Any]:
    """Return what a caller in rospy gets."""

    async def works(_request: Any) -> Any:
        return {"success": True, "message": "grün"}

    async def refuses(_request: Any) -> Any:
        raise smartcam.TriggerError("not running")

    async def empty(_request: Any) -> Any:
        return {}

    for name, kind, handler in (
        ("works", "Trigger", works),
        ("refuses", "Trigger", refuses),
        ("empty", "Empty", empty),
        ("fails", "Empty", refuses),
    ):
        node.serve(f"~/{name}", f"std_srvs/srv/{kind}", handler)
    found = {
        name: await peer.ask("call", f"{node.full_name}/{name}", kind, {})
        for name, kind in (
            ("works", TRIGGER), ("refuses", TRIGGER), ("empty", EMPTY), ("fails", EMPTY),
            ("fails", EMPTY),
        )
    }  # fmt: skip
    await peer.ask("own", "/peer/own", TRIGGER)
    found["median"] = {
        name: await peer.ask("median", service, TRIGGER, {}, 300)
        for name, service in (("bridge", f"{node.full_name}/works"), ("rospy", "/peer/own"))
    }
    return found


async def a_cut(node: RosbridgeNode, peer: Program, proxy: Proxy) -> dict[str, Any]:
    """Return what becomes of calls when the way to the bridge breaks and the bridge lives."""
    calls, began = 0, asyncio.Event()

    async def handler(_request: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 1:
            began.set()
            await asyncio.Event().wait()
        return {"success": True, "message": f"call {calls}"}

    service = node.serve("~/slow", "std_srvs/srv/Trigger", handler)
    old = peer.ask("call", service.name, TRIGGER, {})
    await began.wait()
    proxy.cut()
    late = peer.ask("call", service.name, TRIGGER, {})
    return {
        "old": await old,
        "late": await late,
        "new": await peer.ask("sure", service.name, TRIGGER, {}),
        "calls": calls,
        "text": await peer.ask("get", f"{node.full_name}/text", "std_msgs/String"),
    }


async def _graph(peer: Program) -> Any:
    """Return what there is, once the second camera is there as well; or what there is by then."""
    found: Any = {}
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(60):
            while "/cam4/trigger" not in found.get("services", ()):
                found = await peer.ask("state")
                await asyncio.sleep(0.1)
    return found


async def cameras(peer: Program) -> dict[str, Any]:
    """Return what rospy has of the cameras of the command."""
    camera = "/line1/cam3"
    there = {"camera_name": "line1/cam3", "timeout": 20.0}
    poses = peer.ask("get", f"{camera}/localizations", "geometry_msgs/PoseArray")
    found = {
        "status": await peer.ask("get", f"{camera}/status", "smartcam_msgs/CameraStatus"),
        "run": await peer.ask("sure", f"{camera}/run", "std_srvs/SetBool", {"data": True}),
        "localized": await peer.ask("sure", f"{camera}/TriggerLocalization", LOCALIZE, there),
        "other": await peer.ask(
            "sure", f"{camera}/TriggerLocalization", LOCALIZE, {**there, "camera_name": "cam4"}
        ),
        "diagnostics": await peer.ask("get", "/diagnostics", "diagnostic_msgs/DiagnosticArray"),
    }
    while not poses.done():  # who subscribes takes a moment
        await peer.ask("sure", f"{camera}/trigger", TRIGGER, {})
    found["calibrated"] = await peer.ask("calibrate", camera, "table")
    return {**found, "poses": await poses, "graph": await _graph(peer)}


async def main(folder: Path, command: list[str]) -> dict[str, Any]:
    generate(folder)
    generate_transforms(folder)
    (folder / "fleet.yaml").write_text(FLEET)
    more = [str(folder), os.environ.get("PYTHONPATH", "")]
    ros = {"ROS_MASTER_URI": f"http://127.0.0.1:{MASTER}", "ROS_IP": "127.0.0.1"}
    os.environ.update(ros, ROS_LOG_DIR=str(folder), PYTHONPATH=os.pathsep.join(more))
    async with contextlib.AsyncExitStack() as stack:
        enter = stack.enter_async_context
        await enter(Program(folder, "master", "rosmaster", "--core", "-p", str(MASTER)))
        await listening(MASTER)
        proxy = await enter(Proxy())
        peer = await enter(Program(folder, "peer", PYTHON, str(ROOT / "tests/ros1/rospy_peer.py")))
        url = f"ws://127.0.0.1:{PROXY}"
        fleet = (str(folder / "fleet.yaml"), "--bridge", url, "--json")
        ours = await enter(
            Program(folder, "smartcam", sys.executable, "-m", "smartcam", "ros1", *fleet)
        )
        found: dict[str, Any] = {"lines": [json.loads(await ours.lines.get()) for _ in range(2)]}
        node = await enter(RosbridgeNode("probe", bridge=url, backoff=smartcam.Backoff(maximum=1)))
        async with bridge_of(folder, command):
            await node.wait_connected(60)
            found["lines"] += [json.loads(await ours.lines.get()) for _ in range(2)]
            found["topics"] = await topics(node, peer)
            found["services"] = await services(node, peer)
            found["cut"] = await a_cut(node, peer, proxy)
            found["cameras"] = await cameras(peer)
        async with bridge_of(folder, command):
            await node.wait_connected(60)
            found["again"] = await peer.ask("sure", "/probe/works", TRIGGER, {})
            found["camera again"] = await peer.ask("sure", "/cam4/stop", TRIGGER, {})
            await node.stop()
            ours.process.send_signal(signal.SIGINT)
            found["code"] = await ours.process.wait()
            found["files"] = sorted(one.name for one in (folder / "calibrations").iterdir())
            found["left"] = (await peer.ask("state"))["services"]
    return found


if __name__ == "__main__":
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)  # noqa: S607
    own_bridge = [PYTHON, str(ROOT / "tests" / "ros1" / "bridge_server.py")]
    seen = asyncio.run(main(Path(sys.argv[1]), sys.argv[2:] or own_bridge))
    sys.stdout.write(json.dumps(seen))
