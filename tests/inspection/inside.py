"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.inspection._camera import frame_inspector
from smartcam.inspection._camera.frame_inspector import failed_values
from smartcam.inspection._locate.find import LocatedPart, PartSearch, locate
from smartcam.inspection._locate.troubles import TeachingTrouble
from smartcam.inspection._measure.edges import (
    Choice,
    Edge,
    EdgeSettings,
    PairChoice,
    Polarity,
    noise_of,
)
from smartcam.inspection._measure.features import (
    CurveEdges,
    FoundPoint,
    find_circle,
    find_line,
    find_pair,
    find_point,
    strip_between,
)
from smartcam.inspection._measure.fits import Edges, fit_circle, fit_line
from smartcam.inspection._measure.planes import PIXELS, Plane, measuring_plane
from smartcam.inspection._measure.strips import Sectors, Strips
from smartcam.inspection._measure.troubles import NotMeasuredError, NoValueReason
from smartcam.inspection._measure.values import (
    Value,
    distance,
    fit_circle_in_plane,
    fit_line_in_plane,
    measure_with_calibration,
    point_in_plane,
    width,
)
from smartcam.inspection._program import MAX_REASON_BYTES
from smartcam.inspection._read import gs1
from smartcam.inspection._read.codes import ReadCode, formats_of, read_codes
from smartcam.inspection._read.gs1 import GS, split_elements
from smartcam.inspection._read.tool import ReadSettings, ReadTool
