"""Write example lines that use a calibration, for people to copy to a shell or into Python."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Any

from smartcam.calibration._hand_eye.result import KIND as HAND_EYE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

_TRIGGER_TEMPLATE = """\
import smartcam.sync
from smartcam.calibration import load_calibration

calibration = load_calibration({path!r})
with smartcam.sync.connect(
    {arguments},
    calibration=calibration,
) as camera:
    for part in camera.trigger().value:
        print(part.feature_id, part.pose.position)  # in the robot's frame, metres
"""

_TRANSFORM_TEMPLATE = """\
from smartcam.calibration import load_calibration

calibration = load_calibration({path!r})
print(calibration.transform([{point!r}]))  # metres
"""

_LOAD_TEMPLATE = """\
from smartcam.calibration import HandEyeCalibration

calibration = HandEyeCalibration.load({path!r})
print(calibration.camera_pose)  # of the camera, metres
"""


def usage(
    kind: str,
    path: Path,
    connect: Mapping[str, Any] | None = None,
    point: Sequence[float] = (),
) -> dict[str, str]:
    """Return lines that use a calibration: ``command`` for a shell, and ``python``.

    ``path``: path of the calibration's file. ``connect``: arguments of :func:`smartcam.connect` for
    the camera, ``url`` included; None: the camera is not known. ``point`` (2,): a point that the
    camera saw.
    """
    text = str(path)
    if kind == HAND_EYE or connect is None:
        listing = ["smartcam", "calibrate", "--list", "--folder", str(path.parent)]
        template = _LOAD_TEMPLATE if kind == HAND_EYE else _TRANSFORM_TEMPLATE
        python = template.format(path=text, point=[round(value, 4) for value in point])
        return {"command": shlex.join(listing), "python": python}
    options = {name: value for name, value in connect.items() if value not in (None, "", False)}
    url = str(options.pop("url"))
    words = ["smartcam", "trigger", url, "--calibration", text]
    for name, value in options.items():
        words += [f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])]
    arguments = [repr(url), *(f"{name}={value!r}" for name, value in options.items())]
    python = _TRIGGER_TEMPLATE.format(path=text, arguments=",\n    ".join(arguments))
    return {"command": shlex.join(words), "python": python}
