"""Codes of errors and remarks about calibrations."""

from __future__ import annotations

import enum
from typing import NamedTuple

from smartcam._arguments import excerpt
from smartcam.exceptions import CalibrationError

MAX_VALUE_CHARACTERS = 200
"""Largest number of characters of a value that the text of an error shows."""


class Code(enum.StrEnum):
    """Value of ``code`` in a :class:`~smartcam.CalibrationError` or a :class:`Remark`."""

    # samples
    SHAPE = "SHAPE"
    """An argument is not as expected: its type or value, an array's shape, different lengths."""
    NOT_FINITE = "NOT_FINITE"
    """A number is NaN or infinity, or it is not positive where it must be."""
    TOO_FEW = "TOO_FEW"
    """Fewer points than the model needs."""
    COINCIDENT = "COINCIDENT"
    """Points, cameras or views that should be apart are at the same place."""
    COLLINEAR = "COLLINEAR"
    """The points lie so nearly on a line that other directions are not determined."""
    SHORT_LEVER = "SHORT_LEVER"
    """The points lie too close together for the error with which the robot touched them."""
    MIRRORED = "MIRRORED"
    """Left and right are exchanged: a camera's frame is left-handed as seen from the tool's side (y
    points the wrong way), a robot's base is left-handed, or pictures were flipped."""
    SIDE_UNKNOWN = "SIDE_UNKNOWN"
    """The side from which the plane is touched is not given: mirrored input is not detected."""
    SCALE_MISMATCH = "SCALE_MISMATCH"
    """The scale of the points is not the nominal one: the print, the units or the height is
    wrong."""
    SCALE_ASSUMED = "SCALE_ASSUMED"
    """The scale was taken from the user; no point measures it."""
    NOT_PLANAR = "NOT_PLANAR"
    """The robot's points lie farther from a plane than errors of touching explain."""
    POOR_FIT = "POOR_FIT"
    """The residuals are larger than errors of touching, or of views, explain."""
    OUTLIER = "OUTLIER"
    """A point fits far worse than the others; as an error: at least half of the points do."""
    WRONG_ORDER = "WRONG_ORDER"
    """Touches fit far better if they are assigned to other points: they were exchanged."""
    REFUTED = "REFUTED"
    """Touches made to check a finished calibration are farther off than the limit."""
    NOT_SIMILAR = "NOT_SIMILAR"
    """One scale does not fit the whole field: the camera is tilted, or its lens distorts."""
    NOT_HELD_OUT = "NOT_HELD_OUT"
    """Too few points to leave one out: the calibration's error cannot be estimated."""
    UNVERIFIED = "UNVERIFIED"
    """The touching error is unknown, so no error is predicted."""
    OUT_OF_FIELD = "OUT_OF_FIELD"
    """A point that the calibration cannot map: behind the horizon of the plane."""
    OUT_OF_PLANE = "OUT_OF_PLANE"
    """A pose that does not lie in the camera's plane."""
    WRONG_FRAME = "WRONG_FRAME"
    """A pose is given in another frame than the calibration's."""
    PLANE_MOVED = "PLANE_MOVED"
    """The camera was raised, tilted or turned over, so it sees the plane elsewhere than before."""
    INSUFFICIENT_ROTATION = "INSUFFICIENT_ROTATION"
    """The poses differ too little in orientation, or are turned about one axis only."""
    POSES_TOO_SIMILAR = "POSES_TOO_SIMILAR"
    """Poses that should differ are nearly the same."""

    # frames
    NOT_RIGID = "NOT_RIGID"
    """A matrix or quaternion that is not a rotation: reflected, scaled or not valid."""
    BAD_TIME = "BAD_TIME"
    """A time is missing, or no pose is known for it."""
    NOT_SIMULTANEOUS = "NOT_SIMULTANEOUS"
    """Two values that belong to different times."""

    # images
    TARGET_NOT_FOUND = "TARGET_NOT_FOUND"
    """The image does not show the target, or not enough of it."""
    WRONG_TARGET = "WRONG_TARGET"
    """The image shows another target than the described one."""
    AMBIGUOUS_ORIGIN = "AMBIGUOUS_ORIGIN"
    """The target's origin cannot be distinguished clearly from its other corners."""
    WRONG_SIZE = "WRONG_SIZE"
    """An image of another size than the camera's, or than the other images."""
    DIFFERENT_TARGETS = "DIFFERENT_TARGETS"
    """Views of several targets instead of a single one."""
    BAD_VIEW = "BAD_VIEW"
    """A view that fits far worse than the others and is left out."""
    SWAPPED_SIDES = "SWAPPED_SIDES"
    """The camera named right stands to the left of the camera named left."""
    POOR_COVERAGE = "POOR_COVERAGE"
    """The views show the target in too few places, sizes or tilts to determine the lens well."""
    SHEET_NOT_EXACT = "SHEET_NOT_EXACT"
    """The points of a printed target are not where they were meant to be."""
    PAGE_TOO_SMALL = "PAGE_TOO_SMALL"
    """A sheet's target does not fit on its page."""
    LENS_UNKNOWN = "LENS_UNKNOWN"
    """No lens was given: its distortion is not corrected."""
    NO_PICTURE = "NO_PICTURE"
    """No picture came in time, or there is no source of pictures."""
    BAD_PICTURE = "BAD_PICTURE"
    """A picture that cannot be read: damaged, too large or of an unknown format."""

    # steps, files and services
    WRONG_ANSWERS = "WRONG_ANSWERS"
    """Answers that do not fit the step's inputs; ``got`` has a text for each wrong one."""
    STALE_STEP = "STALE_STEP"
    """A token of another step than the current one."""
    NOT_POSSIBLE = "NOT_POSSIBLE"
    """The call is not possible now: nothing to undo or to repeat, or the sequence has ended."""
    NO_SEQUENCE = "NO_SEQUENCE"
    """No sequence was started."""
    NO_CALIBRATION = "NO_CALIBRATION"
    """No calibration was loaded."""
    WRONG_JOURNAL = "WRONG_JOURNAL"
    """A journal of another wizard, or of another version of this wizard."""
    IN_USE = "IN_USE"
    """Another process or sequence writes to the journal or the folder."""
    BAD_NAME = "BAD_NAME"
    """A name that is not allowed for a file, or that leads out of the folder."""
    NOT_FOUND = "NOT_FOUND"
    """No such file."""
    BROKEN_FILE = "BROKEN_FILE"
    """A file that was damaged or changed, or was not written by smartcam."""
    WRONG_KIND = "WRONG_KIND"
    """A file of smartcam that holds another kind of value."""
    NEWER_VERSION = "NEWER_VERSION"
    """A file of a newer version of smartcam, which this version cannot interpret."""
    NOT_STORABLE = "NOT_STORABLE"
    """A value that JSON cannot hold exactly: NaN, infinity, an object."""
    NOT_WRITTEN = "NOT_WRITTEN"
    """A file that could not be written: the disk is full, or permission is missing."""

    # formats of other programs
    UNKNOWN_FORMAT = "UNKNOWN_FORMAT"
    """There is no format or robot convention of this name."""
    UNIT_UNKNOWN = "UNIT_UNKNOWN"
    """The unit of lengths or angles is not given, or the values are implausible in this unit."""
    MALFORMED = "MALFORMED"
    """A file of another program that does not follow its format."""

    # covariances and known lenses
    NOT_A_COVARIANCE = "NOT_A_COVARIANCE"
    """A matrix that is not a covariance: not symmetric, or with a negative variance."""
    SWAPPED_LENSES = "SWAPPED_LENSES"
    """The known lenses of the two cameras are exchanged."""
    WRONG_LENS = "WRONG_LENS"
    """A known lens reproduces the views worse than a lens that is fitted to them."""

    def error(self, text: str, expected: object = None, got: object = None) -> CalibrationError:
        """Return an error; ``text`` names the expected and the given value."""
        return CalibrationError(text, code=self, expected=expected, got=got)

    def error_with_value(
        self, text: str, expected: object = None, got: object = None
    ) -> CalibrationError:
        """Return an error; ``text`` names the expected value, and ``got`` is appended."""
        try:
            shown_value = f"{got!s:.{MAX_VALUE_CHARACTERS}}"
        except Exception:  # noqa: BLE001 - a foreign class may raise any
            shown_value = excerpt(got)
        return self.error(f"{text}, got {shown_value}", expected, got)

    def remark(self, text: str) -> Remark:
        """Return a remark with this code."""
        return Remark(self, text)


class Remark(NamedTuple):
    """A remark on a calibration that succeeded.

    Attributes:
        code: kind of the remark.
        text: the found and the expected value.
    """

    code: Code
    text: str
