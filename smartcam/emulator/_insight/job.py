"""Define jobs of the emulated In-Sight camera: files, each with a spreadsheet of cells."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from numbers import Real
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Field, field_validator, model_validator

from smartcam._forks import cached_property
from smartcam._user_code import ENDS_PROGRAM
from smartcam.emulator._data import EmulatorData, Seconds
from smartcam.emulator._generators import Values  # noqa: TC001 - beside pydantic's models
from smartcam.emulator._inspected import Inspector
from smartcam.exceptions import ConfigurationError
from smartcam.protocols._inside import words
from smartcam.settings import validated

_log = logging.getLogger("smartcam.emulator")

EXTENSIONS = (".job", ".jobx")
"""Extensions of job files on older, then on newer cameras (published)."""

MAX_CELL_TEXT_CHARACTERS = 1024
"""Largest number of characters of a cell's text; a bound of the emulator."""

CellValue: TypeAlias = bool | int | float | str
"""A value that a cell may hold. The spreadsheet has only numbers and texts; a bool is the number 0
or 1."""

_Name = Annotated[str, Field(min_length=1, max_length=255)]


class Control(EmulatorData):
    """An edit control in a cell, which ``SI``, ``SF`` and ``SS`` may set.

    Its value is set back when the job is loaded.
    """

    kind: Literal["int", "float", "string"] = Field(
        description="command that sets the cell: SI an int, SF a float, SS a string"
    )
    value: int | float | str = Field(description="content when the job is loaded")
    low: float | None = Field(default=None, description="least number that is taken")
    high: float | None = Field(default=None, description="greatest number that is taken")
    max_length: int = Field(
        default=255, ge=1, le=MAX_CELL_TEXT_CHARACTERS, description="characters of a string"
    )

    def admits(self, value: CellValue) -> bool:
        """Return True if a value has the cell's type, lies within its bounds and fits a line."""
        if isinstance(value, str):
            fits = len(value) <= self.max_length and (value == "" or _printable(value))
            return self.kind == "string" and fits
        if self.kind == "string" or not math.isfinite(value):
            return False
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        return low <= value <= high

    @model_validator(mode="after")
    def _check(self) -> Control:
        kinds: Mapping[str, tuple[type, ...]] = {
            "int": (int,),
            "float": (int, float),
            "string": (str,),
        }
        if isinstance(self.value, bool) or not isinstance(self.value, kinds[self.kind]):
            raise ValueError(f"a control for {self.kind} cannot hold {self.value!r}")  # noqa: TRY004
        if not self.admits(self.value):
            raise ValueError(f"{self.value!r} is outside the control's own bounds")
        return self


CellSource: TypeAlias = Control | CellValue | list[CellValue] | Callable[[int], CellValue]
"""The source of a cell's value: a control, a constant, a list (one value per acquisition,
repeated), or a function of the run's number, which is 1 for the first since the job was loaded."""


class Job(EmulatorData):
    """A program on the camera: a file, and the spreadsheet in it.

    Raises:
        pydantic.ValidationError: a field is wrong.
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(
        frozen=True, extra="forbid", arbitrary_types_allowed=True
    )

    file: _Name = Field(
        description="name of its file; a number of up to three digits at its beginning is its id"
    )
    cells: dict[str, Any] = Field(
        default_factory=dict[str, Any],
        description=(
            "cell (A1) or name of a cell to a control, a constant, a list or a function of the "
            "run's number"
        ),
    )
    rate: float | None = Field(
        default=None,
        ge=0.0001,
        le=1000,
        allow_inf_nan=False,
        description="acquisitions per second while online; None: it waits for triggers",
    )
    load_time: Seconds = Field(default=0.5, description="seconds until it is loaded")
    acquisition_time: Seconds = Field(
        default=0.02, description="seconds from a trigger until the image is there"
    )
    processing_time: Seconds = Field(
        default=0.03, description="seconds from the image until the cells are there"
    )

    @cached_property
    def id(self) -> int | None:
        """Number at the beginning of the file name (manual, published); None without one."""
        return words.job_id(self.file)

    @property
    def triggered(self) -> bool:
        """True if the job waits for triggers: only then do ``SE8`` and ``SW8`` work (published)."""
        return self.rate is None

    def is_called(self, name: str) -> bool:
        """Return True if ``name`` is the name of the job's file, with the extension or without."""
        return name == self.file or any(name + end == self.file for end in EXTENSIONS)

    @cached_property
    def sources(self) -> Mapping[str, Any]:
        """Sources of the job's cells by :func:`cell_key`."""
        return {cell_key(name): source for name, source in self.cells.items()}

    def loaded_cells(self) -> dict[str, str]:
        """Return the cells' texts after the job is loaded: cells that need a run are in error."""
        return {key: self._source_text(key, source, 0) for key, source in self.sources.items()}

    def update_cells(self, cells: dict[str, str], run: int) -> None:
        """Update the cells after run number ``run``, from 1; controls keep their values."""
        for key, source in self.sources.items():
            if not isinstance(source, Control):
                cells[key] = self._source_text(key, source, run)

    def _source_text(self, key: str, source: Any, run: int) -> str:
        if isinstance(source, Control):
            return cell_text(source.value)
        if isinstance(source, list):
            return cell_text(source[(run - 1) % len(source)]) if run else words.ERROR_VALUE
        if callable(source):
            return self._function_text(key, source, run) if run else words.ERROR_VALUE
        return cell_text(source)

    def _function_text(self, key: str, function: Callable[[int], Any], run: int) -> str:
        try:
            return cell_text(function(run))
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:  # noqa: BLE001 - a cell that fails shows it, as on the camera
            _log.warning("! job %s: cell %s failed in run %d: %r", self.file, key, run, exc)
            return words.ERROR_VALUE

    @field_validator("file")
    @classmethod
    def _check_file(cls, file: str) -> str:
        if not _printable(file) or file != file.strip():
            raise ValueError("a file name has printable Latin-1 characters, none blank at its ends")
        return file

    @field_validator("cells", mode="before")
    @classmethod
    def _read_controls(cls, cells: Any) -> Any:
        if not isinstance(cells, Mapping):
            return cells
        return {
            name: Control.model_validate(source) if isinstance(source, Mapping) else source
            for name, source in cells.items()
        }

    @model_validator(mode="after")
    def _check_cells(self) -> Job:
        names_by_key: dict[str, str] = {}
        for name, source in self.cells.items():
            key = cell_key(name)
            if key in names_by_key:
                raise ValueError(f"cells {names_by_key[key]!r} and {name!r} are the same")
            names_by_key[key] = name
            if isinstance(source, Control) or callable(source):
                continue
            values = source if isinstance(source, list) else [source]
            if not values:
                raise ValueError(f"cell {name}: the list is empty")
            for value in values:
                try:
                    cell_text(value)
                except (TypeError, ValueError) as exc:
                    raise ValueError(f"cell {name}: {exc}") from exc
        return self


class InspectedJob(Job):
    """A job whose cells an inspector fills from a picture.

    ``cells`` names them; each is in error until a run has given it a value. A list of records puts
    its values into ``NAME_1``, ``NAME_2``, ...
    """

    inspector: Inspector = Field(description="the program that inspects the pictures")
    application: int = Field(description="id of the program for the inspector")

    def loaded_cells(self) -> dict[str, str]:
        """Return the cells' texts after the job is loaded: all need a run, so are in error."""
        return dict.fromkeys(self.sources, words.ERROR_VALUE)

    def fill_cells(self, cells: dict[str, str], values: Values | None) -> None:
        """Put an inspector's values into the cells; cells without a value are in error."""
        cells.update(self.loaded_cells())
        for name, value in _named_values(values):
            key = cell_key(name)
            if key in self.sources:
                cells[key] = self._source_text(key, value, 0)

    def _source_text(self, key: str, source: Any, run: int) -> str:
        try:
            return cell_text(source)
        except (TypeError, ValueError) as exc:
            _log.warning("! job %s: cell %s: %s", self.file, key, exc)
            return words.ERROR_VALUE


def _named_values(values: Values | None) -> Iterator[tuple[str, Any]]:
    """Yield values with the names of their cells."""
    if isinstance(values, Mapping):
        for name, value in values.items():
            if isinstance(value, Sequence) and not isinstance(value, str):
                yield from _named_values(value)
            else:
                yield name, value
        return
    for number, record in enumerate(values or (), start=1):
        for name, value in _named_values(record):
            yield f"{name}_{number}", value


def cell_key(name: str) -> str:
    """Return the key of a cell or of a cell's name: ``A012``, or the name in lower case.

    Raises:
        ConfigurationError: the text is neither. It is a ValueError, as pydantic expects.
    """
    try:
        return words.parse_cell(name).wire
    except ConfigurationError as not_a_cell:
        try:
            return words.parse_tag(name)
        except ConfigurationError as exc:
            raise exc from not_a_cell


def cell_text(value: Any) -> str:
    """Return a value as the text of a cell, like ``GV``: numbers have three decimals (derived).

    A number that is not finite gives a cell in error.

    Raises:
        TypeError: the value is no number and no text.
        ValueError: a text that does not fit a line.
    """
    if isinstance(value, str):
        if len(value) > MAX_CELL_TEXT_CHARACTERS or not (value == "" or _printable(value)):
            raise ValueError(
                f"a text has at most {MAX_CELL_TEXT_CHARACTERS} printable Latin-1 characters, "
                f"got {value!r}"
            )
        return value
    if not isinstance(value, Real):
        raise TypeError(f"a cell holds a number or a text, got {value!r}")
    try:
        number = float(value)
    except OverflowError:
        return words.ERROR_VALUE
    return f"{number:.3f}" if math.isfinite(number) else words.ERROR_VALUE


def make_job(given: Job | Mapping[str, Any]) -> Job:
    """Return ``given`` as a job.

    Raises:
        ConfigurationError: a field is wrong; the text names the job and the field.
    """
    if isinstance(given, Job):
        return given
    file = given.get("file", "?") if isinstance(given, Mapping) else "?"
    return validated(Job, given, f"job {file}")


def _printable(text: str) -> bool:
    return text.isprintable() and all(ord(character) < 256 for character in text)


BUILTIN_JOBS = (
    Job(
        file="1PartCheck.job",
        cells={
            "Passed": True,
            "A1": 101.5,
            "B1": -3.25,
            "C1": "ABC",
            "Threshold": Control(kind="float", value=0.5, low=0, high=1),
        },
    ),
    Job(file="7Counter.job", cells={"A1": lambda run: run}, load_time=0.3),
    Job(file="9Free.job", cells={"A1": lambda run: run}, rate=20),
)
"""Default jobs: constants with a control, a count of triggers, a free run."""
