"""One word for each thing that can be wrong with a calibration."""

from __future__ import annotations

import enum
from typing import NamedTuple

from smartcam._arguments import shown
from smartcam.exceptions import CalibrationError

MAX_VALUE_CHARACTERS = 200
"""Largest number of characters of a value that the text of an error shows."""


class Code(enum.StrEnum):
    """``code`` of a :class:`~smartcam.CalibrationError` and of a :class:`Remark`."""

    # samples
    SHAPE = "SHAPE"
    """The numbers do not come in the shape that is expected, or not as many of each."""
    NOT_FINITE = "NOT_FINITE"
    """NaN or infinity among the numbers."""
    TOO_FEW = "TOO_FEW"
    """Fewer points than the model has need of."""
    COINCIDENT = "COINCIDENT"
    """Points that should be apart are the same; or cameras, or views."""
    COLLINEAR = "COLLINEAR"
    """The points lie on a line, or so nearly that the rest is not determined."""
    SHORT_LEVER = "SHORT_LEVER"
    """The points lie too close together for how well they are touched."""
    MIRRORED = "MIRRORED"
    """Left and right are exchanged: a camera's frame is left-handed as seen from the tool's side (y
    points the wrong way), a robot's base is, or pictures were flipped."""
    SIDE_UNKNOWN = "SIDE_UNKNOWN"
    """From which side the plane is touched was not told: mirrored input could not be noticed."""
    SCALE_MISMATCH = "SCALE_MISMATCH"
    """The scale of the points is not the nominal one: print, units or height differ."""
    SCALE_ASSUMED = "SCALE_ASSUMED"
    """The scale was taken from the user; no point measures it."""
    NOT_PLANAR = "NOT_PLANAR"
    """The touched points lie further from a plane than touching explains."""
    POOR_FIT = "POOR_FIT"
    """The residuals are larger than touching explains."""
    OUTLIER = "OUTLIER"
    """A point that fits far worse than the others; as an error, half of the points or more."""
    WRONG_ORDER = "WRONG_ORDER"
    """Touches that fit far better when they are taken for those of other points: exchanged ones."""
    REFUTED = "REFUTED"
    """Touches after a calibration was made lie further off than is allowed."""
    NOT_SIMILAR = "NOT_SIMILAR"
    """One scale for the whole field does not do: the camera is tilted, or its lens distorts."""
    NOT_HELD_OUT = "NOT_HELD_OUT"
    """Too few points to leave one out: nothing tells how good the calibration is."""
    UNVERIFIED = "UNVERIFIED"
    """Nothing tells how well the points were touched: no predicted error."""
    OUT_OF_FIELD = "OUT_OF_FIELD"
    """A point that the calibration cannot map: behind the horizon of the plane."""
    OUT_OF_PLANE = "OUT_OF_PLANE"
    """A pose that does not lie in the camera's plane."""
    WRONG_FRAME = "WRONG_FRAME"
    """A pose is given in another frame than the calibration's."""
    PLANE_MOVED = "PLANE_MOVED"
    """The camera moved in a way that moves the plane it sees."""
    INSUFFICIENT_ROTATION = "INSUFFICIENT_ROTATION"
    """The poses are turned too little against each other."""
    POSES_TOO_SIMILAR = "POSES_TOO_SIMILAR"
    """Poses that should differ are nearly the same."""

    # frames
    NOT_RIGID = "NOT_RIGID"
    """No rotation: a reflection, a scale, a quaternion that is not valid."""
    BAD_TIME = "BAD_TIME"
    """A time that is missing, or for which nothing is known."""
    NOT_SIMULTANEOUS = "NOT_SIMULTANEOUS"
    """Two things that belong to different times."""

    # images
    TARGET_NOT_FOUND = "TARGET_NOT_FOUND"
    """The image does not show the target, or not enough of it."""
    WRONG_TARGET = "WRONG_TARGET"
    """The image shows a target that is not the one that was described."""
    AMBIGUOUS_ORIGIN = "AMBIGUOUS_ORIGIN"
    """The target's origin cannot be told from its other corners with a margin."""
    WRONG_SIZE = "WRONG_SIZE"
    """An image of another size than the camera's, or than the other images."""
    DIFFERENT_TARGETS = "DIFFERENT_TARGETS"
    """Views of several targets where those of one are expected."""
    BAD_VIEW = "BAD_VIEW"
    """A view that fits far worse than the others; it is left out."""
    SWAPPED_SIDES = "SWAPPED_SIDES"
    """The camera that is called right stands left of the one that is called left."""
    POOR_COVERAGE = "POOR_COVERAGE"
    """The views show the target in too few places, sizes or tilts to tell the lens well."""
    SHEET_NOT_EXACT = "SHEET_NOT_EXACT"
    """The points of a printed target are not where they were meant to be."""
    PAGE_TOO_SMALL = "PAGE_TOO_SMALL"
    """A sheet's target does not fit on its page."""
    LENS_UNKNOWN = "LENS_UNKNOWN"
    """No lens was given: its distortion is not corrected."""
    NO_PICTURE = "NO_PICTURE"
    """No picture came in time, or nowhere it could come from."""
    BAD_PICTURE = "BAD_PICTURE"
    """A picture that cannot be read: damaged, too large, of no known format."""

    # steps, files and services
    WRONG_ANSWERS = "WRONG_ANSWERS"
    """Answers that do not fit the step's inputs; ``got`` has a text for each wrong one."""
    STALE_STEP = "STALE_STEP"
    """A token of another step than the current one."""
    NOT_POSSIBLE = "NOT_POSSIBLE"
    """Nothing to undo or to repeat, or the sequence has ended."""
    NO_SEQUENCE = "NO_SEQUENCE"
    """No sequence was started."""
    NO_CALIBRATION = "NO_CALIBRATION"
    """No calibration was loaded."""
    WRONG_JOURNAL = "WRONG_JOURNAL"
    """A journal that another wizard wrote, or another version of it."""
    IN_USE = "IN_USE"
    """Another process, or another sequence of this one, writes the journal or in the folder."""
    BAD_NAME = "BAD_NAME"
    """A name that no file may have, or that leads out of the folder."""
    NOT_FOUND = "NOT_FOUND"
    """No such file."""
    BROKEN_FILE = "BROKEN_FILE"
    """A file that was damaged or changed, or is no file of smartcam."""
    WRONG_KIND = "WRONG_KIND"
    """A file of smartcam with other contents."""
    NEWER_VERSION = "NEWER_VERSION"
    """A file of a newer smartcam, whose meaning this one does not know."""
    NOT_STORABLE = "NOT_STORABLE"
    """A value that JSON cannot hold exactly: NaN, infinity, an object."""
    NOT_WRITTEN = "NOT_WRITTEN"
    """A file that could not be written: the disk is full, or nobody may write there."""

    # formats of other programs
    UNKNOWN_FORMAT = "UNKNOWN_FORMAT"
    """No format, or no robot's convention, of this name."""
    UNIT_UNKNOWN = "UNIT_UNKNOWN"
    """Nothing says in which unit lengths or angles are, or they are implausible in the one that is
    said."""
    MALFORMED = "MALFORMED"
    """A file of another program that is not what its format says."""

    # what belongs to something else
    NO_COVARIANCE = "NO_COVARIANCE"
    """Matrices that are no covariances: not symmetric, or with a negative variance."""
    SWAPPED_LENSES = "SWAPPED_LENSES"
    """The known lens of each camera is the other one's."""
    WRONG_LENS = "WRONG_LENS"
    """A known lens shows the views worse than one that is fitted to them."""

    def refusal(self, text: str, expected: object = None, got: object = None) -> CalibrationError:
        """Return the error for what is refused; ``text`` says what was expected and what came."""
        return CalibrationError(text, code=self, expected=expected, got=got)

    def unexpected(
        self, text: str, expected: object = None, got: object = None
    ) -> CalibrationError:
        """Return the same error; ``text`` says what was expected, and ``got`` is said behind it."""
        try:
            came = f"{got!s:.{MAX_VALUE_CHARACTERS}}"
        except Exception:  # noqa: BLE001 - whatever a class of somebody's raises there
            came = shown(got)
        return self.refusal(f"{text}, got {came}", expected, got)

    def remark(self, text: str) -> Remark:
        """Return the remark of this code."""
        return Remark(self, text)


class Remark(NamedTuple):
    """A remark on a calibration that could be made.

    Attributes:
        code: what it is, in one word.
        text: what was found and what was expected.
    """

    code: Code
    text: str
