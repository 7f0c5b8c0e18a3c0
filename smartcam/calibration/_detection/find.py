"""Printed targets in images: :func:`find_target`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.calibration._detection.charucos import find_charuco
from smartcam.calibration._detection.checkerboards import find_checkerboard
from smartcam.calibration._detection.circle_grids import find_circles
from smartcam.calibration._detection.image import grey_image
from smartcam.calibration._detection.marker_grids import find_marker_grid
from smartcam.calibration._targets import Charuco, Checkerboard, CircleGrid, MarkerGrid
from smartcam.geometry import Code

if TYPE_CHECKING:
    from smartcam.calibration._targets import Target
    from smartcam.calibration._views import TargetView


def find_target(image: Any, target: Target, *, name: str = "") -> TargetView:
    """Find a target's points in an image.

    Corners of squares are found where two fitted edges cross, dots by the fitted ellipse of their
    rim, from whose middle the centre is told by how the whole grid is seen. All points of a grid of
    dots must be seen; of a checkerboard some in each row and column, most of them in the outermost
    ones, those that are covered are left out, or any part with the origin's mark; of a ChArUco
    board at least four. Its markers are held against each other by the board's map: those that
    stand elsewhere than their numbers say are left out and named in the view's ``warnings``. Dots
    may be dark on light or light on dark; a grid that goes on beside them is refused.

    Points are numbered as the target does. Its origin is told by its mark, its larger dot or its
    ids; without these by the outermost square there, which is black, where only one of the corners
    in question has a black one. Where nothing tells it, the target's x points to the right of the
    image rather than to the left.

    A mirrored image is refused where the print tells it: of a ChArUco board; of a checkerboard or a
    grid of dots with a mark or a larger dot at its origin, unless it is square (as many columns as
    rows; of an asymmetric grid, half as many); of a checkerboard without a mark whose columns and
    rows are odd and differ, by its black corners; of an asymmetric grid with an even count of rows
    that is not square. The mirror image of any other target looks like the target itself when it is
    turned: its view has the points mirrored, and nothing in one image tells it.

    An image without a target is given up after work that is bounded: by the saddles, dark spots or
    quadrangles that are looked at, and from how many of them a grid is grown.

    Args:
        image: uint8 or uint16, (H, W) or (H, W, 3) with blue, green, red; 16 to 20,000 pixels wide
            and high. Or a :class:`~smartcam.frames.Frame`, whose brightness counts.
        target: what is printed on the sheet.
        name: name of the image, for messages.

    Returns:
        Points with a covariance that follows from the noise in the image alone: what its
        compression, the print or the lens do to an edge comes on top. A corner that cannot be
        fitted stays where it was found first, with a standard deviation of a quarter of a pixel or
        more.

    Raises:
        CalibrationError: SHAPE: no such image, or a ChArUco board of an unknown dictionary;
            TARGET_NOT_FOUND; WRONG_TARGET: markers contradict the target's description: they stand
            as on a board of the other ``legacy_pattern``, of other counts, or on several boards;
            AMBIGUOUS_ORIGIN: the mark is not darker than the other corners by 30 grey levels of
            255; MIRRORED: the image shows the target as in a mirror, or, where only its black
            corners tell, as a negative or with columns and rows exchanged.
        MissingExtraError: OpenCV is not installed, or what reads a compressed frame.
        FrameFormatError: a frame has no brightness, or its bytes are wrong.
    """
    grey = grey_image(image)
    match target:
        case Checkerboard():
            return find_checkerboard(grey, target, name)
        case Charuco():
            return find_charuco(grey, target, name)
        case CircleGrid():
            return find_circles(grey, target, name)
        case MarkerGrid():
            return find_marker_grid(grey, target, name)
    got = type(target).__name__
    raise Code.SHAPE.unexpected(
        "target: expected a Checkerboard, Charuco, CircleGrid or MarkerGrid", got=got
    )
