"""Find the points of a printed target in an image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.calibration._detection.charucos import find_charuco
from smartcam.calibration._detection.checkerboards import find_checkerboard
from smartcam.calibration._detection.circle_grids import find_circles
from smartcam.calibration._detection.image import grey_image
from smartcam.calibration._detection.marker_grids import find_marker_grid
from smartcam.calibration._targets import Charuco, Checkerboard, CircleGrid, MarkerGrid
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from smartcam.calibration._targets import Target
    from smartcam.calibration._views import TargetView


def find_target(image: Any, target: Target, *, name: str = "") -> TargetView:
    """Find a target's points in an image.

    Corners of squares are found where two fitted edges cross, dots by an ellipse fitted to their
    rim, whose centre is corrected for perspective by the map of the whole grid. All dots of a grid
    must be visible. A checkerboard without a mark must show some corners in each row and column,
    and most corners of the outermost rows and columns; covered corners are left out. Of one with a
    mark at its origin, any part that includes the mark is enough. Of a ChArUco board at least four
    corners must be visible. The places of its markers are compared with the board: markers that are
    not where their ids belong are left out and named in the view's ``warnings``. Dots may be dark
    on light or light on dark; a grid with more dots than the target is refused.

    Points are numbered as in the target. The target's origin is known by its mark, its larger dot
    or its ids. A target without these has its origin at the corner with a black outermost square,
    if only one of the possible corners has one. Otherwise the target's x points to the right of the
    image rather than to the left.

    Mirrored images of these targets are recognized and refused: ChArUco boards; checkerboards and
    grids of dots with a mark or a larger dot at the origin, unless they are square (as many columns
    as rows; of an asymmetric grid, half as many); checkerboards without a mark whose counts of
    columns and rows are odd and differ; asymmetric grids with an even count of rows that are not
    square. The mirror image of any other target looks like the target itself after a turn: the view
    then has mirrored points, which nothing in a single image can show.

    The time spent on an image without a target is bounded, since only a limited number of saddles,
    dark spots or quadrangles is examined, and grids are grown from only a few of them.

    Args:
        image: uint8 or uint16, (H, W) or (H, W, 3) with blue, green, red; 16 to 20,000 pixels wide
            and high. Or a :class:`~smartcam.frames.Frame`, of which the brightness is used.
        target: the print on the sheet.
        name: name of the image, for messages.

    Returns:
        Points with a covariance that follows from the noise in the image alone; it does not include
        errors that compression, the print or the lens add. A corner that cannot be fitted stays
        where it was found first, with a standard deviation of a quarter of a pixel or more.

    Raises:
        CalibrationError: SHAPE: the array is no such image, or the ChArUco board has an unknown
            dictionary; TARGET_NOT_FOUND; WRONG_TARGET: markers contradict the target's description:
            they are arranged as on a board of the other ``legacy_pattern``, of other counts, or as
            on several boards; AMBIGUOUS_ORIGIN: the mark is not darker than the other corners by 30
            grey levels of 255; MIRRORED: the image shows the target as in a mirror, or, where only
            its black corners tell, as a negative or with columns and rows exchanged.
        MissingExtraError: OpenCV is not installed, or the decoder of a compressed frame.
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
    type_name = type(target).__name__
    raise Code.SHAPE.error_with_value(
        "target: expected a Checkerboard, Charuco, CircleGrid or MarkerGrid", got=type_name
    )
