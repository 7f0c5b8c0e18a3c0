"""Save calibrations to files, and list the forms in which their fields are stored.

The forms are those of ``smartcam/geometry/_stored.py``, which explains them. They are imported here
only so that ``storage.rows`` can be written instead of ``rows``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from smartcam.calibration._files import store
from smartcam.calibration._targets import Target, target_from_data, target_to_data
from smartcam.calibration._verdict import warn_unless_good
from smartcam.geometry._inside import (
    AsList as AsList,
)
from smartcam.geometry._inside import (
    Context as Context,
)
from smartcam.geometry._inside import (
    Count as Count,
)
from smartcam.geometry._inside import (
    ExtraKeys as ExtraKeys,
)
from smartcam.geometry._inside import (
    Form as Form,
)
from smartcam.geometry._inside import (
    Keys as Keys,
)
from smartcam.geometry._inside import (
    Matrix3 as Matrix3,
)
from smartcam.geometry._inside import (
    Matrix43 as Matrix43,
)
from smartcam.geometry._inside import (
    NonNegative as NonNegative,
)
from smartcam.geometry._inside import (
    NullableTriple as NullableTriple,
)
from smartcam.geometry._inside import (
    Number as Number,
)
from smartcam.geometry._inside import (
    NumberOrNaN as NumberOrNaN,
)
from smartcam.geometry._inside import (
    Pair as Pair,
)
from smartcam.geometry._inside import (
    PairOrNaN as PairOrNaN,
)
from smartcam.geometry._inside import (
    Positive as Positive,
)
from smartcam.geometry._inside import (
    Remarks as Remarks,
)
from smartcam.geometry._inside import (
    SheetOffsets as SheetOffsets,
)
from smartcam.geometry._inside import (
    Size as Size,
)
from smartcam.geometry._inside import (
    Stored as Stored,
)
from smartcam.geometry._inside import (
    Triple as Triple,
)
from smartcam.geometry._inside import (
    Vector2 as Vector2,
)
from smartcam.geometry._inside import (
    Vector3 as Vector3,
)
from smartcam.geometry._inside import (
    as_array as as_array,
)
from smartcam.geometry._inside import (
    check_counts as check_counts,
)
from smartcam.geometry._inside import (
    check_shape as check_shape,
)
from smartcam.geometry._inside import (
    invalid_data_error as invalid_data_error,
)
from smartcam.geometry._inside import (
    matrix as matrix,
)
from smartcam.geometry._inside import (
    motion as motion,
)
from smartcam.geometry._inside import (
    row as row,
)
from smartcam.geometry._inside import (
    rows as rows,
)

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Self


class SavedCalibration(Stored):
    """A calibration that can be saved to a file."""

    kind: ClassVar[str]
    """Kind of the calibration, as its file names it."""

    def save(self, path: str | Path) -> None:
        """Write the calibration to a file, whole or not at all."""
        store.write(path, self.kind, self.to_data())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file that :meth:`save` wrote; log a warning if the calibration is not good.

        Raises:
            CalibrationError: the file is damaged, newer, or of another kind.
            OSError: the file does not exist, or cannot be read.
        """
        calibration = cls.from_data(store.read(path, cls.kind))
        warn_unless_good(calibration, str(path))
        return calibration


StoredTarget = Annotated[
    Target, Form(dict[str, Any], lambda data, _: target_from_data(data), target_to_data)
]
