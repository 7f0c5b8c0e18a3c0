"""Find out from recorded metadata whether results were interpreted as poses in metres."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING, Any

from smartcam._client._inside import has_pixel_positions, localizations_of, name_if_poseless
from smartcam.exceptions import SmartCamError
from smartcam.interpreters import resolve

if TYPE_CHECKING:
    from smartcam.interpreters import Interpreter
    from smartcam.models import Localization, Result


class RecordedInterpreters:
    """The interpreters that ``interpret_as`` names, for all applications or for each.

    Args:
        spec: value of ``interpret_as``, or its text; "" if it is not known.
        pixels: whether positions are in pixels, whatever ``spec`` is.
    """

    def __init__(self, spec: Any = "", *, pixels: bool = False) -> None:
        if isinstance(spec, str) and spec.startswith("{"):
            try:
                spec = ast.literal_eval(spec)
            except (ValueError, SyntaxError, MemoryError, RecursionError):
                spec = ""
        specs: Any = spec if hasattr(spec, "items") else {None: spec}
        self._by_application = {key: _resolved(spec) for key, spec in specs.items()}
        self._pixels = pixels
        self._with_localizations: set[int] = set()  # applications that had localizations

    def localizations(self, result: Result) -> list[Localization] | None:
        """Return a result's localizations in metres; None without any, or if they are in pixels.

        An empty list counts as localizations if its application had some.
        """
        found, application = localizations_of(result.value), result.application
        interpreter = self._by_application.get(application, self._by_application.get(None))
        pixels = self._pixels or has_pixel_positions(interpreter)
        if found:
            self._with_localizations.add(application)
            calibrated = found[0].pose.header.frame_id != result.camera
            return None if pixels and not calibrated else found
        has_poses = interpreter is not None and name_if_poseless(interpreter) is None and not pixels
        return found if has_poses or application in self._with_localizations else None


def _resolved(spec: Any) -> Interpreter | None:
    try:
        return resolve(spec) if spec else None
    except SmartCamError:  # a plug-in that is not installed
        return None
