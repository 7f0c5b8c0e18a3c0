"""Programs that inspect the pictures of a plain camera: what makes a smart camera of it.

::

    cell = smartcam.inspection.load_cell("cell.yaml")
    program = cell["line1/cam1"].program(12)
    inspection = program.inspect(frame)            # blocks; in any thread, several at once
    inspection.ok, inspection.reason, inspection.value.text
    payload = inspection.payload()                 # the bytes, which program.interpret_as reads

A *tool* looks at a picture: a plug-in, found by its name among the entry points of the group
``smartcam.tools``. A *program* is the list of tools of an application, in order. A *finding* is
what one tool says: values, a verdict with its reason, marks to draw, and a frame of reference that
later tools may follow. An *inspection* is all of that for one picture. The layout of a result
follows from the program.

Nothing here knows a socket or a clock of a camera. The extra ``inspection`` brings what it needs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.frames._inside import Drawing
    from smartcam.inspection._camera.client import SoftwareCamera
    from smartcam.inspection._camera.device import SoftwareDevice
    from smartcam.inspection._cell import (
        CellCamera,
        Software,
        load_cell,
        make_camera,
        software_mistakes,
    )
    from smartcam.inspection._finding import Finding, Inspection
    from smartcam.inspection._locate.find import LocatedPart
    from smartcam.inspection._locate.model import PartModel
    from smartcam.inspection._locate.troubles import TeachingError, TeachingTrouble
    from smartcam.inspection._picture import Picture
    from smartcam.inspection._places import PixelPose, Region
    from smartcam.inspection._program import Program, register_tool
    from smartcam.inspection._teaching import Teaching
    from smartcam.inspection._tool import Tool, ToolSettings, ToolSetup, View

__all__ = [
    "CellCamera",
    "Drawing",
    "Finding",
    "Inspection",
    "LocatedPart",
    "PartModel",
    "Picture",
    "PixelPose",
    "Program",
    "Region",
    "Software",
    "SoftwareCamera",
    "SoftwareDevice",
    "Teaching",
    "TeachingError",
    "TeachingTrouble",
    "Tool",
    "ToolSettings",
    "ToolSetup",
    "View",
    "load_cell",
    "make_camera",
    "register_tool",
    "software_mistakes",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_camera.client": "SoftwareCamera",
            "_camera.device": "SoftwareDevice",
            "_cell": "CellCamera Software load_cell make_camera software_mistakes",
            "_finding": "Finding Inspection",
            "_locate.find": "LocatedPart",
            "_locate.model": "PartModel",
            "_locate.troubles": "TeachingError TeachingTrouble",
            "_picture": "Picture",
            "_places": "PixelPose Region",
            "_program": "Program register_tool",
            "_teaching": "Teaching",
            "_tool": "Tool ToolSettings ToolSetup View",
            "smartcam.frames._inside": "Drawing",
        },
    )
