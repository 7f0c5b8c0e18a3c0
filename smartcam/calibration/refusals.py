"""Codes of what sequence, store and services refuse; those of samples are in ``codes``."""

from __future__ import annotations

import enum

__all__ = ["Refusal"]


class Refusal(enum.StrEnum):
    """``code`` of a :class:`~smartcam.CalibrationError` that is about no sample."""

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
    """Another process, or another sequence of this one, writes the journal."""
    BAD_NAME = "BAD_NAME"
    """A name that no file may have, or that leads out of the folder."""
    NOT_FOUND = "NOT_FOUND"
    """No such file."""
    BROKEN_FILE = "BROKEN_FILE"
    """A file that was damaged or changed, or is no file of ours."""
    WRONG_KIND = "WRONG_KIND"
    """A file of ours that holds something else."""
    NEWER_VERSION = "NEWER_VERSION"
    """A file of a newer smartcam, whose meaning this one does not know."""
    NOT_STORABLE = "NOT_STORABLE"
    """A value that JSON cannot hold exactly: NaN, infinity, an object."""
