"""A small rosbridge on rospy, for Debian's Python: ``bridge_server.py PORT``, on the loopback.

It has the operations that smartcam uses. As rosbridge_suite's branch ros1 it has services of all
links in one table, keeps them when their link goes, counts their calls from one, lets a call wait
without end, and takes no notice of a response's ``result``.
"""

import base64
import contextlib
import hashlib
import json
import socketserver
import sys
import threading
from typing import Any

import genpy  # type: ignore[import-not-found]
import roslib.message  # type: ignore[import-not-found]
import rospy  # type: ignore[import-not-found]

GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"

services: dict[str, Any] = {}
publishers: dict[str, Any] = {}
subscribers: dict[str, Any] = {}
responses: dict[str, Any] = {}
changed = threading.Condition()


def filled(message: Any, said: Any) -> Any:
    """Fill a message with what JSON says."""
    if not isinstance(said, dict):
        raise TypeError(f"{message._type}: no object: {said!r:.60}")
    types = dict(zip(message.__slots__, message._slot_types, strict=True))
    for name, value in said.items():
        kind, now = types[name], getattr(message, name)
        if isinstance(now, genpy.rostime.TVal):
            value = type(now)(value["secs"], value["nsecs"])
        elif kind.startswith("uint8[") and isinstance(value, str):
            value = base64.b64decode(value, validate=True)
        elif "[" in kind and "/" in kind:
            make = roslib.message.get_message_class(kind.partition("[")[0])
            value = [filled(make(), one) for one in value]
        elif isinstance(now, genpy.Message):
            value = filled(now, value)
        setattr(message, name, value)
    return message


def said_of(value: Any) -> Any:
    """Return what JSON says of a message's value."""
    if isinstance(value, genpy.Message):
        return {name: said_of(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, genpy.rostime.TVal):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, (list, tuple)):
        return [said_of(one) for one in value]
    return value


class Served:
    """A service that a link has advertised."""

    def __init__(self, name: str, kind: str, link: Any) -> None:
        self.name, self.link, self.count, self.withdrawn = name, link, 0, False
        self.make = roslib.message.get_service_class(kind)
        self.server = rospy.Service(name, self.make, self.call)

    def call(self, request: Any) -> Any:
        with changed:
            self.count += 1
            number = f"service_request:{self.name}:{self.count}"
        said = {"op": "call_service", "id": number, "service": self.name}
        self.link.send({**said, "args": said_of(request)})
        with changed:
            changed.wait_for(lambda: number in responses or self.withdrawn)
            return None if self.withdrawn else responses.pop(number)

    def withdraw(self) -> Any:
        with changed:
            self.withdrawn = True
            changed.notify_all()
        self.server.shutdown("withdrawn")


class Link(socketserver.StreamRequestHandler):
    """One WebSocket."""

    def handle(self) -> Any:
        head = b""
        while line := self.rfile.readline().strip():
            if line.lower().startswith(b"sec-websocket-key:"):
                head = line.partition(b":")[2].strip()
        accept = base64.b64encode(hashlib.sha1(head + GUID, usedforsecurity=False).digest())
        self.lock = threading.Lock()
        self.wfile.write(
            b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Accept: " + accept + b"\r\n\r\n"
        )
        try:
            while (text := self.read()) is not None:
                self.hear(json.loads(text))
        except OSError:
            pass  # it is gone

    def read(self) -> Any:
        """Return the next text, None at the end."""
        while True:
            head = self.rfile.read(2)
            if len(head) < 2:
                return None
            kind, size = head[0] & 15, head[1] & 127
            if size > 125:
                size = int.from_bytes(self.rfile.read(2 if size == 126 else 8), "big")
            mask = self.rfile.read(4)
            data = self.rfile.read(size)
            whole = (mask * (size // 4 + 1))[:size]
            data = (int.from_bytes(data, "big") ^ int.from_bytes(whole, "big")).to_bytes(
                size, "big"
            )
            if kind == 1:
                return data
            if kind == 9:
                self.frame(10, data)
            if kind == 8:
                self.frame(8, data)
                return None

    def frame(self, kind: Any, data: Any) -> Any:
        size = len(data)
        told = bytes([size]) if size < 126 else b"\x7e" + size.to_bytes(2, "big")
        if size > 0xFFFF:
            told = b"\x7f" + size.to_bytes(8, "big")
        with self.lock:
            self.wfile.write(bytes([0x80 | kind]) + told + data)

    def send(self, operation: Any) -> Any:
        with contextlib.suppress(OSError, ValueError):  # it is gone: who waits for an answer waits
            self.frame(1, json.dumps(operation).encode())

    def hear(self, said: Any) -> Any:
        try:
            getattr(self, "on_" + said["op"])(said)
        except Exception as error:  # noqa: BLE001 - it goes on, and says so
            sys.stderr.write(f"bridge: {said['op']}: {error!r}\n")
            told = {"op": "status", "level": "error", "msg": f"{said['op']}: {error!r}"}
            self.send(told)

    def on_advertise(self, said: Any) -> Any:
        if said["topic"] not in publishers:
            make = roslib.message.get_message_class(said["type"])
            latch = said.get("latch", False)
            publisher = rospy.Publisher(said["topic"], make, latch=latch, queue_size=100)
            publishers[said["topic"]] = publisher, set()
        publishers[said["topic"]][1].add(self)

    def on_unadvertise(self, said: Any) -> Any:
        publisher, links = publishers[said["topic"]]
        links.discard(self)
        if not links:
            del publishers[said["topic"]]
            publisher.unregister()

    def on_publish(self, said: Any) -> Any:
        publisher, _ = publishers[said["topic"]]
        publisher.publish(filled(publisher.data_class(), said["msg"]))

    def on_subscribe(self, said: Any) -> Any:
        make = roslib.message.get_message_class(said["type"])

        def say(message: Any) -> None:
            self.send({"op": "publish", "topic": said["topic"], "msg": said_of(message)})

        subscribers[said["id"]] = rospy.Subscriber(said["topic"], make, say)

    def on_unsubscribe(self, said: Any) -> Any:
        there = subscribers.pop(said["id"], None)
        if there is not None:
            there.unregister()

    def on_advertise_service(self, said: Any) -> Any:
        there = services.pop(said["service"], None)
        if there is not None:
            there.server.shutdown("another came")
        services[said["service"]] = Served(said["service"], said["type"], self)

    def on_unadvertise_service(self, said: Any) -> Any:
        there = services.pop(said["service"], None)
        if there is not None:
            there.withdraw()

    def on_service_response(self, said: Any) -> Any:
        response = filled(services[said["service"]].make._response_class(), said["values"])
        with changed:
            responses[said["id"]] = response
            changed.notify_all()

    def on_call_service(self, said: Any) -> Any:
        answer = {"op": "service_response", "id": said["id"], "service": said["service"]}
        self.send({**answer, "values": "none of its services", "result": False})


class Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = daemon_threads = True


if __name__ == "__main__":
    rospy.init_node("bridge", disable_signals=True)
    with Server(("127.0.0.1", int(sys.argv[1])), Link) as server:
        server.serve_forever()
