"""Services for front-ends on one folder of calibrations: start a wizard, export, load, transform.

A front-end starts a wizard under a name, shows its steps and sends the answers. No request reads or
writes a file outside of the folder.

Source: the thesis with which smartcam began, 2.2.2, Figures 2.8 to 2.12 (published) for the
services.
"""

from __future__ import annotations

import itertools
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from smartcam.calibration._files.directory import EXPORTS, Folder
from smartcam.calibration._files.load import calibration_from_document
from smartcam.calibration._files.store import keep_backup, read_document, replace_file
from smartcam.calibration._plane.calibration import KIND as PLANE_KIND
from smartcam.calibration._plane.calibration import PlaneCalibration
from smartcam.calibration.wizards._journal import Journal
from smartcam.calibration.wizards._listing import list_calibrations
from smartcam.calibration.wizards._sequence import WizardSession
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from smartcam.calibration._files.load import AnyCalibration
    from smartcam.calibration._files.store import Document
    from smartcam.calibration.wizards._sequence import Wizard

MAX_EARLIER_JOURNALS = 5
"""Number of journals of earlier runs that are kept for each name."""


MATRIX_SUFFIX = ".yaml"
"""Suffix of a file that holds only a matrix."""


class CalibrationService:
    """Calibrations in a folder, and one wizard at a time that makes or checks a calibration.

    Args:
        folder: folder of the calibrations and journals.
        wizards: the wizards that can be started, by their names; each gets ``name`` among its
            parameters.

    Attributes:
        folder: the folder.

    Raises:
        OSError: the folder cannot be created.
    """

    def __init__(
        self, folder: str | os.PathLike[str] | Folder, wizards: Iterable[Wizard] = ()
    ) -> None:
        self.folder: Folder = folder if isinstance(folder, Folder) else Folder(folder)
        self._wizards = {wizard.name: wizard for wizard in wizards}
        self._session: WizardSession | None = None
        self._name: str | None = None
        self._calibration: AnyCalibration | None = None
        self._numbers = itertools.count(1)

    @property
    def names(self) -> list[str]:
        """Names of the calibrations in the folder, sorted."""
        return self.folder.names()

    @property
    def listing(self) -> list[dict[str, Any]]:
        """Rows of JSON data, one for each calibration.

        The keys are ``name``, ``kind``, ``written_at``, ``held_out_mm``, ``checked_at``, ``stale``
        and ``problem``; values that are not known are None. A file that cannot be read has a
        ``problem``.
        """
        return list_calibrations(self.folder)

    @property
    def wizards(self) -> list[str]:
        """Names of the wizards that can be started."""
        return list(self._wizards)

    @property
    def name(self) -> str | None:
        """Name under which the running wizard was started; None: no wizard is running."""
        return self._name

    @property
    def session(self) -> WizardSession:
        """The session of the running wizard, or of the last one that ended.

        Raises:
            CalibrationError: ``NO_SEQUENCE``.
        """
        if self._session is None:
            raise Code.NO_SEQUENCE.error("no calibration is under way; expected one to be started")
        return self._session

    def start(
        self,
        name: str,
        wizard: str = PLANE_KIND,
        parameters: Mapping[str, Any] | None = None,
        *,
        fresh: bool = False,
    ) -> dict[str, Any]:
        """Start a wizard, or resume the interrupted wizard of this name.

        Args:
            name: name of the calibration.
            wizard: kind of the wizard; each kind has a journal of its own for a name.
            parameters: parameters of the wizard's start; a resumed wizard has its own.
            fresh: whether to start from the first step in any case. The journal of the run before
                is kept as an earlier journal.

        Returns:
            The first step, or the step at which the wizard was interrupted, as
            :attr:`WizardSession.current`.

        Raises:
            CalibrationError: ``BAD_NAME``, ``NOT_FOUND`` (the wizard), ``IN_USE``,
                ``WRONG_JOURNAL``, ``BROKEN_FILE``, ``NOT_POSSIBLE`` while an action is under way.
            OSError: the journal cannot be opened or written.
        """
        path = self.folder.journal(name, "" if wizard == PLANE_KIND else wizard)
        if wizard not in self._wizards:
            raise Code.NOT_FOUND.error(
                f"no wizard is called {wizard!r}; expected one of {', '.join(self._wizards)}",
                got=wizard,
            )
        if self._session is not None and self._session.busy:
            raise Code.NOT_POSSIBLE.error(
                "an action is under way; expected it to end or to be aborted"
            )
        self.close()
        start_parameters = {**(parameters or {}), "name": name}
        session = None if fresh else self._open_session(path, wizard, start_parameters)
        if session is None or session.state != "asking":
            if session is not None:
                session.close()
            _move_aside(path)
            session = self._open_session(path, wizard, start_parameters)
        self._session, self._name = session, name
        return self.session.current

    def _open_session(
        self, path: Path, wizard: str, parameters: Mapping[str, Any]
    ) -> WizardSession:
        journal = Journal(path)
        try:
            return WizardSession(self._wizards[wizard], journal, parameters=parameters)
        except BaseException:
            journal.close()
            raise

    def export(self, name: str, target: str, form: str | None = None) -> str:
        """Copy a calibration to a file of ``exports/``, as a backup or for another program.

        Args:
            name: name of the calibration.
            target: name of the file. A ``.json`` file is a copy that :meth:`load` reads. A
                ``.yaml`` file holds the matrix, which PyYAML, ``cv2.FileStorage`` and
                :func:`~smartcam.calibration.formats.read_matrix` read.
            form: format, such as ``tf2``, in which the frame of the calibration's plane is written
                instead of the matrix; the scale is written into a comment.

        Returns:
            The file's path in the folder.

        Raises:
            CalibrationError: ``BAD_NAME``, ``NOT_FOUND``; or the calibration cannot be read.
                ``UNKNOWN_FORMAT``; ``WRONG_KIND``: only a plane's calibration has a matrix;
                ``NOT_SIMILAR``: the calibration has no frame; see
                :func:`~smartcam.calibration.formats.plane_frame`; ``NOT_WRITTEN``: the file cannot
                be written.
        """
        from smartcam.calibration.formats import compose_plane_frame
        from smartcam.calibration.formats._opencv import PlaneMatrix, compose_matrix

        source = self.folder.find(name)
        path = self.folder.export(target)
        document = read_document(source)
        if form is None and path.suffix == ".json":
            body = source.read_bytes()
        elif form is None and path.suffix != MATRIX_SUFFIX:
            raise Code.UNKNOWN_FORMAT.error(
                f"{path.name}: expected the format to be named, or a file that ends in .json or "
                f"{MATRIX_SUFFIX}",
                [".json", MATRIX_SUFFIX],
                path.suffix,
            )
        else:
            calibration = PlaneCalibration.from_data(
                _data_of_kind(document, PLANE_KIND, source.name)
            )
            if form is not None:
                body = compose_plane_frame(form, calibration, suffix=path.suffix).encode()
            else:
                unit = str(document.context.get("camera_unit", "unknown unit"))
                body = compose_matrix(PlaneMatrix.of(calibration), unit).encode()
        replace_file(path, body)
        return f"{EXPORTS}/{path.name}"

    def load(self, name_or_path: str) -> AnyCalibration:
        """Load a calibration of a plane or with a printed sheet, for :meth:`transform` to use.

        Args:
            name_or_path: name of the calibration; or, with a ``/``, path in the folder of an
                exported calibration.

        Raises:
            CalibrationError: ``BAD_NAME``, ``NOT_FOUND``; or the calibration cannot be read.
            OSError: the file cannot be read.
        """
        path = self.folder.find(name_or_path)
        self._calibration = calibration_from_document(read_document(path), path.name)
        return self._calibration

    def transform(self, x: float, y: float, theta: float = 0.0, frame: str | None = None) -> Pose:
        """Return the robot's pose for a pose in the camera's plane, by the loaded calibration.

        Args:
            x: coordinate to the right, in the unit of the calibration.
            y: coordinate upwards; for a calibration by a sheet, whose pixels count down, it is -v.
            theta: angle, counter-clockwise, radians.
            frame: frame in which the result must be; None for the calibration's frame.

        Raises:
            CalibrationError: ``NO_CALIBRATION``, ``WRONG_FRAME``, ``OUT_OF_FIELD``.
        """
        calibration = self._calibration
        if calibration is None:
            raise Code.NO_CALIBRATION.error(
                "no calibration is loaded; expected one to be loaded first"
            )
        if frame not in {None, calibration.robot_frame}:
            raise Code.WRONG_FRAME.error(
                f"frame {frame!r}: expected {calibration.robot_frame!r}",
                calibration.robot_frame,
                frame,
            )
        header = Header(next(self._numbers), datetime.now(UTC), calibration.camera_frame or "")
        pose = Pose(header, Position(x, y), Quaternion.from_theta(theta))
        return calibration.to_robot(Localization("", 1.0, 0, pose)).pose

    def close(self) -> None:
        """Free the running sequence, which can be resumed; do nothing if there is none."""
        if self._session is not None:
            self._session.close()
        self._session = self._name = None


def _move_aside(path: Path) -> None:
    if not path.exists():
        return
    try:
        Journal(path).close()  # fails if another process has this journal open
    except CalibrationError as exc:
        if exc.code != Code.BROKEN_FILE:
            raise
    keep_backup(path, MAX_EARLIER_JOURNALS)
    path.unlink(missing_ok=True)


def _data_of_kind(document: Document, kind: str, name: str) -> dict[str, Any]:
    if document.kind != kind:
        raise Code.WRONG_KIND.error(
            f"{name}: holds {document.kind!r}, expected {kind!r}", kind, document.kind
        )
    return document.data
