"""Import the packages of smartcam's extras, which are optional, when they are first used."""

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
    """A package: its name for users, the extra that installs it, and its purpose with a verb."""

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
    "regex": Package("regex", "inspection", "patterns of texts need"),
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

# modules that are fully imported; sys.modules also has those that are still being imported
_LOADED: Final[dict[str, Any]] = {}


def load(name: str, use: str = "") -> Any:
    """Return a module of an extra, as ``Any``, since it is untyped.

    Args:
        name: dotted name of the module.
        use: the purpose for the error, with its verb: "video needs"; "" for the usual purpose.

    Raises:
        MissingExtraError: the package is not installed, or it is OpenCV 5.0.0.
    """
    loaded = sys.modules.get(name)
    if loaded is not None and loaded is _LOADED.get(name):
        return loaded  # import_module takes longer than the work on a small picture
    try:
        module = importlib.import_module(name)
    except ImportError as exc:
        raise missing_extra_error(name, use) from exc
    version = str(getattr(module, "__version__", ""))
    if name == "cv2" and version.startswith(BROKEN_OPENCV):
        raise missing_extra_error(
            name, use, f"other than {version}, which lacks hand-eye calibration"
        )
    _LOADED[name] = module
    return module


def missing_extra_error(name: str, use: str = "", which: str = "") -> MissingExtraError:
    """Return the error that names the extra to install for a module.

    Args:
        name: dotted name of the module.
        use: as for :func:`load`.
        which: the version required, such as "other than 5.0.0"; "" if any will do.
    """
    called, extra, usual_use = PACKAGES[name.partition(".")[0]]
    package = f"an {called} {which}" if which else called
    text = f'{use or usual_use} {package}: pip install "smartcam[{extra}]"'
    return MissingExtraError(text, extra=extra)


@contextlib.contextmanager
def from_part(extra: str, use: str) -> Iterator[None]:
    """Raise a helpful error if an import in the block needs a part that is not installed.

    Args:
        extra: the extra that installs this part of smartcam.
        use: the purpose for the error, with its verb: "a camera of a fleet needs".

    Raises:
        MissingExtraError: a module of smartcam is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as exc:
        if exc.name is None or not exc.name.startswith("smartcam."):
            raise
        text = f'{use} {exc.name}: pip install "smartcam[{extra}]"'
        raise MissingExtraError(text, extra=extra) from exc
