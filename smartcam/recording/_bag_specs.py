"""How results were read, by what a recorder was told: whether they are poses in metres."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING, Any

from smartcam._client.interpretation import without_poses
from smartcam.exceptions import SmartCamError
from smartcam.interpreters._base import resolve
from smartcam.ros2._camera_reading import in_pixels
from smartcam.ros2._messages import localizations_of

if TYPE_CHECKING:
    from smartcam.interpreters._base import Interpreter
    from smartcam.models import Localization, Result


class Specs:
    """What ``interpret_as`` says, for all applications or for each.

    Args:
        said: as a client takes it, or its text; "" where it was not told.
        pixels: places are pixels, whatever it says.
    """

    def __init__(self, said: Any = "", *, pixels: bool = False) -> None:
        if isinstance(said, str) and said.startswith("{"):
            try:
                said = ast.literal_eval(said)
            except (ValueError, SyntaxError, MemoryError, RecursionError):
                said = ""
        specs: Any = said if hasattr(said, "items") else {None: said}
        self._known = {key: _resolved(one) for key, one in specs.items()}
        self._pixels = pixels
        self._with_parts: set[int] = set()  # applications that gave some

    def parts(self, result: Result) -> list[Localization] | None:
        """Return a result's localizations in metres; None where it has none, or in pixels.

        An empty list is taken for localizations where its application gives these.
        """
        parts, application = localizations_of(result.value), result.application
        reader = self._known.get(application, self._known.get(None))
        pixels = self._pixels or in_pixels(reader)
        if parts:
            self._with_parts.add(application)
            calibrated = parts[0].pose.header.frame_id != result.camera
            return None if pixels and not calibrated else parts
        given = reader is not None and without_poses(reader) is None and not pixels
        return parts if given or application in self._with_parts else None


def _resolved(spec: Any) -> Interpreter | None:
    try:
        return resolve(spec) if spec else None
    except SmartCamError:  # of a plug-in that is not here
        return None
