"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.inspection._camera.judged_frames import judged_source
    from smartcam.inspection._camera.pairing import PictureFinder
    from smartcam.inspection._cell import CellCamera, SoftwareEntry, make_camera, software_mistakes
    from smartcam.inspection._learning import learn_tolerances
    from smartcam.inspection._teaching import Teaching, read_settings, setting_text, tool_settings

__all__ = [
    "CellCamera",
    "PictureFinder",
    "SoftwareEntry",
    "Teaching",
    "judged_source",
    "learn_tolerances",
    "make_camera",
    "read_settings",
    "setting_text",
    "software_mistakes",
    "tool_settings",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_cell": "software_mistakes make_camera SoftwareEntry CellCamera",
            "_camera.judged_frames": "judged_source",
            "_camera.pairing": "PictureFinder",
            "_learning": "learn_tolerances",
            "_teaching": "Teaching read_settings setting_text tool_settings",
        },
    )
