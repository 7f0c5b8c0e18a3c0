"""Pictures through GStreamer (Debian's python3-gi), stamp to stamp: appsrc, x264, RTP, appsink.

``/usr/bin/python3 -m benchmarks.peers.gstreamer_pictures OPTIONS SECONDS`` runs both ends in this
process, with x264enc's options, and prints as JSON the latencies in milliseconds, the bytes of a
picture on the way, and the seconds of CPU and of the clock. The system's Python runs it. Pictures
are drawn and read by the very functions that smartcam draws and reads them with, and go in and come
out as I420, so that nothing is converted.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np

from benchmarks.peers.rospy_pictures import PYTHON
from smartcam.frames._synthetic import read_stamp, stripes, write_stamp

SIZE = (640, 480)
RATE = 30
LIMIT = 30.0
"""Seconds until one that gives no picture is an error."""


ELEMENTS = ("x264enc", "avdec_h264", "rtph264pay", "rtph264depay", "udpsrc", "appsrc", "appsink")


def has_gstreamer() -> bool:
    """Return whether the system's Python has GStreamer, with all elements, and numpy."""
    asked = (
        "import gi, numpy; gi.require_version('Gst', '1.0'); "
        "gi.require_version('GstApp', '1.0'); from gi.repository import Gst, GstApp; "
        f"Gst.init(None); assert all(map(Gst.ElementFactory.find, {ELEMENTS!r}))"
    )
    try:
        found = subprocess.run([PYTHON, "-c", asked], capture_output=True, check=False)
    except OSError:
        return False
    return found.returncode == 0


def main(options: str, seconds: float) -> None:
    """Draw into one pipeline, and read from the other one."""
    import gi  # type: ignore[import-not-found]

    gi.require_version("Gst", "1.0")
    gi.require_version("GstApp", "1.0")
    from gi.repository import Gst, GstApp  # type: ignore[import-not-found]

    assert GstApp is not None  # it has the methods of appsrc and appsink
    Gst.init(None)
    width, height = SIZE
    caps = f"video/x-raw,format=I420,width={width},height={height},framerate={RATE}/1"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    far = Gst.parse_launch(
        f'udpsrc port={port} caps="application/x-rtp,media=video,clock-rate=90000,'
        'encoding-name=H264,payload=96" ! rtph264depay ! avdec_h264 ! '
        "appsink name=out sync=false max-buffers=1 drop=true"
    )
    near = Gst.parse_launch(
        f'appsrc name=in is-live=true do-timestamp=true format=time caps="{caps}" ! '
        f"x264enc {options} ! rtph264pay config-interval=1 ! "
        f"udpsink name=way host=127.0.0.1 port={port} sync=false"
    )
    far.set_state(Gst.State.PLAYING)
    near.set_state(Gst.State.PLAYING)
    into, out, way = near.get_by_name("in"), far.get_by_name("out"), near.get_by_name("way")
    latencies: list[float] = []
    over = threading.Event()
    began_at: list[tuple[float, float, int]] = []

    def read() -> None:
        while not over.is_set():
            sample = out.try_pull_sample(Gst.SECOND // 10)
            if sample is None:
                continue
            buffer = sample.get_buffer()
            mapped, view = buffer.map(Gst.MapFlags.READ)
            if not mapped:
                continue
            grey = np.frombuffer(view.data, np.uint8, width * height).reshape(height, width)
            stamp = read_stamp(grey)
            now = time.monotonic_ns()
            del grey
            buffer.unmap(view)
            if stamp is None:
                continue
            if not began_at:
                sent = way.get_property("bytes-served")
                began_at.append((time.monotonic(), time.process_time(), sent))
            else:
                latencies.append((now - stamp[1]) / 1e6)

    reading = threading.Thread(target=read)
    reading.start()
    picture, grey = stripes(width, height), b"\x80" * (width * height // 2)
    begin, number = time.monotonic(), 0
    while not began_at or time.monotonic() < began_at[0][0] + seconds:
        if time.monotonic() > begin + LIMIT + seconds:
            over.set()
            raise RuntimeError("GStreamer: no picture came through")
        number += 1
        time.sleep(max(0.0, begin + number / RATE - time.monotonic()))
        shown = np.roll(picture, number % width, axis=1)
        write_stamp(shown, number, time.monotonic_ns())
        into.emit("push-buffer", Gst.Buffer.new_wrapped(shown.tobytes() + grey))
    since, cpu, sent = began_at[0]
    found: dict[str, Any] = {
        "latencies": latencies,
        "size": (way.get_property("bytes-served") - sent) / max(1, len(latencies)),
        "cpu": time.process_time() - cpu,
        "seconds": time.monotonic() - since,
    }
    over.set()
    reading.join()
    near.set_state(Gst.State.NULL)
    far.set_state(Gst.State.NULL)
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
