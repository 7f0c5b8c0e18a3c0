"""Programs that inspect pictures, and so turn a plain camera into a smart camera.

::

    cell = smartcam.inspection.load_cell("cell.yaml")
    program = cell["line1/cam1"].program(12)
    inspection = program.inspect(frame)   # blocks; any threads may call it at once
    inspection.ok, inspection.reason, inspection.value.text
    payload = inspection.payload()  # bytes in the layout program.interpret_as

A *tool* inspects a picture; each kind of tool is a plug-in, an entry point of the group
``smartcam.tools``. A *program* is the ordered list of tools of an application. A *finding* is the
result of one tool: values, a verdict with its reason, marks to draw, and a frame of reference that
later tools may follow. An *inspection* holds all findings of one picture. The program determines
the layout of a result.

A program needs no camera and no network. The extra ``inspection`` installs the dependencies.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.frames._inside import Drawing
    from smartcam.inspection._camera.client import SoftwareCamera
    from smartcam.inspection._camera.device import SoftwareDevice
    from smartcam.inspection._cell import load_cell
    from smartcam.inspection._finding import Finding, Inspection
    from smartcam.inspection._locate.find import LocatedPart
    from smartcam.inspection._locate.model import PartModel
    from smartcam.inspection._locate.troubles import TeachingError
    from smartcam.inspection._picture import Picture
    from smartcam.inspection._places import PixelPose, Region
    from smartcam.inspection._program import Program, register_tool
    from smartcam.inspection._tool import Tool, ToolSettings, ToolSetup, View

__all__ = [
    "Drawing",
    "Finding",
    "Inspection",
    "LocatedPart",
    "PartModel",
    "Picture",
    "PixelPose",
    "Program",
    "Region",
    "SoftwareCamera",
    "SoftwareDevice",
    "TeachingError",
    "Tool",
    "ToolSettings",
    "ToolSetup",
    "View",
    "load_cell",
    "register_tool",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_camera.client": "SoftwareCamera",
            "_camera.device": "SoftwareDevice",
            "_cell": "load_cell",
            "_finding": "Finding Inspection",
            "_locate.find": "LocatedPart",
            "_locate.model": "PartModel",
            "_locate.troubles": "TeachingError",
            "_picture": "Picture",
            "_places": "PixelPose Region",
            "_program": "Program register_tool",
            "_tool": "Tool ToolSettings ToolSetup View",
            "smartcam.frames._inside": "Drawing",
        },
    )
