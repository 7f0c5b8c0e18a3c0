"""Import what the extras bring, where it is first used."""

from __future__ import annotations

import contextlib
import importlib
import sys
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam.exceptions import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Iterator

BROKEN_OPENCV = "5.0.0"
"""The OpenCV whose Python binding lacks hand-eye calibration (opencv/opencv#29565)."""


class Package(NamedTuple):
    """A package that an extra brings: its name for users, the extra, and what mostly needs it."""

    called: str
    extra: str
    use: str


PACKAGES: Final = {
    "aiohttp": Package("aiohttp", "web", "the web page needs"),
    "aiomqtt": Package("aiomqtt", "mqtt", "outlets over MQTT need"),
    "asyncua": Package("asyncua", "opcua", "outlets over OPC UA need"),
    "av": Package("PyAV", "video", "video needs"),
    "cryptography": Package("cryptography", "fleet", "certificates need"),
    "cv2": Package("OpenCV", "calibration", "calibration needs"),
    "ezdxf": Package("ezdxf", "inspection", "outlines in DXF need"),
    "fontTools": Package("fontTools", "inspection", "outlines in SVG need"),
    "hypothesis": Package("hypothesis", "suites", "smartcam's suites draw bytes with"),
    "imagecodecs": Package("imagecodecs", "frames", "PNG and JPEG XL need"),
    "lz4": Package("lz4", "record", "recordings need"),
    "paho": Package("paho-mqtt", "mqtt", "outlets over MQTT need"),
    "prometheus_client": Package("prometheus-client", "operations", "metrics need"),
    "rosbags": Package("rosbags", "ros2", "messages of ROS need"),
    "ruamel": Package("ruamel.yaml", "inspection", "teaching needs"),
    "scipy": Package("SciPy", "calibration", "calibration needs"),
    "simplejpeg": Package("simplejpeg", "frames", "JPEG needs"),
    "small_gicp": Package("small-gicp", "depth", "registration needs"),
    "threadpoolctl": Package("threadpoolctl", "calibration", "calibration needs"),
    "yaml": Package("PyYAML", "yaml", "YAML needs"),
    "zenoh": Package("Zenoh", "fleet", "a fleet over the network needs"),
    "zxingcpp": Package("zxing-cpp", "inspection", "reading codes needs"),
    "zstandard": Package("zstandard", "record", "recordings need"),
}

_LOADED: Final[dict[str, Any]] = {}  # whole; sys.modules has those that another thread is at, too


def load(name: str, use: str = "") -> Any:
    """Return a module that an extra brings; untyped, which is why it is any.

    Args:
        name: dotted name of the module.
        use: what needs it, with its verb, for the error; "" for what mostly does.

    Raises:
        MissingExtraError: the package is not installed, or it is OpenCV 5.0.0.
    """
    there = sys.modules.get(name)
    if there is not None and there is _LOADED.get(name):
        return there  # import_module looks for longer than a small picture takes
    try:
        module = importlib.import_module(name)
    except ImportError as exc:
        raise missing(name, use) from exc
    version = str(getattr(module, "__version__", ""))
    if name == "cv2" and version.startswith(BROKEN_OPENCV):
        raise missing(name, use, f"other than {version}, which lacks hand-eye calibration")
    _LOADED[name] = module
    return module


def missing(name: str, use: str = "", which: str = "") -> MissingExtraError:
    """Return the error that says which extra to install for a module.

    Args:
        name: dotted name of the module.
        use: as for :func:`load`.
        which: what the package must be, where not every version will do.
    """
    called, extra, usual = PACKAGES[name.partition(".")[0]]
    wanted = f"an {called} {which}" if which else called
    text = f'{use or usual} {wanted}: pip install "smartcam[{extra}]"'
    return MissingExtraError(text, extra=extra)


@contextlib.contextmanager
def from_part(extra: str, use: str) -> Iterator[None]:
    """Import what another distribution of smartcam brings, which may not be installed.

    Args:
        extra: the extra that brings the distribution.
        use: what needs it, with its verb, for the error.

    Raises:
        MissingExtraError: a module of smartcam is not there.
    """
    try:
        yield
    except ModuleNotFoundError as exc:
        if exc.name is None or not exc.name.startswith("smartcam."):
            raise
        text = f'{use} {exc.name}: pip install "smartcam[{extra}]"'
        raise MissingExtraError(text, extra=extra) from exc
