"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.calibration._detection import charucos, corners
from smartcam.calibration._detection.charucos import charuco_board
from smartcam.calibration._detection.corners import UNREFINED_SIGMA_PX, refine_corners
from smartcam.calibration._detection.grid_growing import (
    MAX_SEEDS_TRIED,
    _GridGrower,
    area_test,
    grow_grids,
)
from smartcam.calibration._detection.image import grey_image, resize_image
from smartcam.calibration._detection.markers import (
    MAX_MEAN_OUTLINES,
    MAX_OUTLINES,
    WINDOWS_PX,
    Markers,
    _outlines,
    compare_with_board,
    marker_finder,
)
from smartcam.calibration._files import store
from smartcam.calibration._files.store import (
    BACKUPS,
    keep_backup,
    read,
    read_document,
    replace_file,
    write,
)
from smartcam.calibration._hand_eye.closed_forms import (
    OPENCV_METHODS,
    check_motion,
    left_out_second_axis_turns,
    second_axis_turn,
    solve_closed_form,
)
from smartcam.calibration._hand_eye.equations import (
    Observations,
    PixelObservations,
    PoseObservations,
    RobotNoise,
    RobotPoses,
    Setup,
    Solution,
    adjust,
    bend_heights,
    leave_each_out,
    predicted_views,
    view_products,
)
from smartcam.calibration._homography import apply_homography, element_derivatives, fit_homography
from smartcam.calibration._lens.bundle import (
    Bundle,
    IndexedView,
    adjust_weighted,
    leave_out,
    lens_values,
    residuals,
    with_lens,
)
from smartcam.calibration._lens.bundle import adjust as bundle_adjust
from smartcam.calibration._lens.coverage import Coverage, coverage
from smartcam.calibration._lens.intrinsics import ViewFit
from smartcam.calibration._lens.poses import half_turned
from smartcam.calibration._lens.projection import (
    excess_variance,
    linearize,
    pixels_by_pose,
    whitening,
)
from smartcam.calibration._lens.sheet_shape import adjust_shape, choose_shape, moved_to_nominal
from smartcam.calibration._plane.calibration import PlaneModel
from smartcam.calibration._plane.fitting import (
    MODELS,
    Fit,
    ModelName,
    Normalization,
    Pairs,
    fit,
    held_out,
)
from smartcam.calibration._printing.page import (
    Disc,
    Label,
    Polygon,
    PrintedPage,
    pdf,
    rectangle,
    svg,
)
from smartcam.calibration._printing.page_layout import BORDER_MM, RULER_MM
from smartcam.calibration._printing.sheets import Rays, Sheet, page_size
from smartcam.calibration._solvers import CameraPosition2D, Poses, RealWorldPosition, Solver
from smartcam.calibration._stereo.checks import check_cameras_apart, check_fit, side_remarks
from smartcam.calibration.formats._cameras import (
    FORMS,
    CameraForm,
    compose_camchain,
    compose_camera_info,
    compose_opencv,
    parse_opencv,
)
from smartcam.calibration.formats._file_format import MAX_TEXT_BYTES, Format
from smartcam.calibration.formats._plain import format_real, load_json, load_yaml
from smartcam.calibration.simulation import _scenes
from smartcam.calibration.wizards import _journal
from smartcam.calibration.wizards._journal import MAX_LINE_BYTES, Journal
from smartcam.calibration.wizards._view_suggestions import Look, outline
