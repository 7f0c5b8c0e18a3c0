"""Define the settings of outlets, which deliver results to brokers, databases and PLCs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from smartcam._file_values import Patterns, Size, matches_any
from smartcam.exceptions import ConfigurationError, PluginError
from smartcam.layout._inside import read_model
from smartcam.outlets._outlet import Outlet
from smartcam.outlets._spool import Policy
from smartcam.registry import OUTLETS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

MAX_OUTLETS = 64
"""Largest number of outlets of one process; each has a thread and a file."""

MAX_SECRET_BYTES = 4096


class _OutletFields(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )


class Secret(_OutletFields):
    """The place of a secret, such as a password: a settings file never has the secret itself."""

    file: str | None = Field(None, min_length=1, description="path of a file with only the secret")
    variable: str | None = Field(
        None,
        pattern=r"^[A-Za-z_][A-Za-z0-9_]*$",
        description="environment variable with the value",
    )

    @model_validator(mode="before")
    @classmethod
    def _refuse_literal(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            raise ValueError(  # noqa: TRY004 - pydantic tells the place of a ValueError
                "a secret is never in this file itself: expected {file: PATH} or {variable: NAME}"
            )
        if len(value) != 1:
            raise ValueError("expected either file or variable")
        return value

    def read(self, folder: Path) -> str:
        """Return the secret.

        Args:
            folder: folder to which a relative ``file`` refers.

        Raises:
            ConfigurationError: the secret cannot be read; the text names its file or variable.
        """
        if self.variable is not None:
            value = os.environ.get(self.variable)
            if value is None:
                raise ConfigurationError(f"the environment variable {self.variable} is not set")
            return value
        path = folder / Path(self.file or "").expanduser()
        try:
            with path.open("rb") as stream:
                return stream.read(MAX_SECRET_BYTES).decode().rstrip("\r\n")
        except OSError as exc:
            raise ConfigurationError(f"the secret's file {path}: {exc.strerror}") from exc
        except UnicodeDecodeError:
            raise ConfigurationError(f"the secret's file {path} is not UTF-8") from None


class OutletSettings(_OutletFields):
    """The settings that every outlet has; each kind adds its own."""

    kind: str | None = Field(None, description="the kind of outlet; default: the outlet's name")
    cameras: Patterns = Field(
        ("**",), description="cameras: names, * for one part of a name, ** for any number"
    )
    spool: str = Field(
        "outlets",
        min_length=1,
        description="folder of the spool, beside this file; made if missing",
    )
    size: Size = Field(1e9, description="largest size of the waiting entries, such as 1 GB")
    full: Policy = Field(
        "drop_oldest",
        description="what to do when the spool is full; drop_oldest: drop the oldest entry; "
        "drop_newest: drop the new one. Dropped entries are counted, and an entry about the gap is "
        "delivered instead",
    )
    durable: bool = Field(
        False,
        description="whether each write waits for the disk, so that a power failure loses "
        "nothing; slower",
    )
    timeout: float = Field(
        30.0, gt=0, le=3600, description="seconds of the timeout for delivering a batch"
    )

    def chooses(self, camera: str) -> bool:
        """Return True if this outlet is for a camera of this name."""
        return matches_any(self.cameras, camera)


Section = dict[str, dict[str, Any]]
"""The section ``outlets:`` of a file: settings by the outlet's name."""


class OutletsFile(_OutletFields):
    """Outlets of one camera in a file of their own."""

    outlets: Section = Field(description="outlets by name; one without kind has its name as kind")

    @classmethod
    def load(cls, path: str | Path) -> OutletsFile:
        """Read a file.

        Raises:
            ConfigurationError: the file cannot be read, or a field is wrong; the error has line and
                field.
            MissingExtraError: the extra ``yaml`` is not installed.
        """
        return read_model(
            path, "outlets", cls, "outlets", lambda file: next(mistakes_of(file.outlets), None)
        )


def outlet_class(name: str, fields: Mapping[str, Any]) -> type[Outlet[Any]]:
    """Return the class of an outlet.

    Raises:
        PluginError: the outlet's kind is unknown or cannot be loaded.
    """
    kind = fields.get("kind") or name
    class_ = OUTLETS.load(str(kind))
    if not (isinstance(class_, type) and issubclass(class_, Outlet)):
        raise PluginError(f"smartcam.outlets: {kind} is not a subclass of Outlet", name=str(kind))
    return class_


def mistakes_of(section: Section) -> Iterator[tuple[Sequence[int | str], str]]:
    """Yield each mistake in a section ``outlets:``: the keys of its place, and a text."""
    if len(section) > MAX_OUTLETS:
        yield ("outlets",), f"{len(section)} outlets, expected {MAX_OUTLETS} at most"
        return
    for name, fields in section.items():
        if not name.replace("-", "").replace("_", "").isalnum() or not name.isascii():
            yield ("outlets", name), "expected a name of letters, digits, - and _"
            continue
        try:
            outlet_class(name, fields).settings_class.model_validate(fields)
        except PluginError as exc:
            if "kind" in fields:
                yield ("outlets", name, "kind"), str(exc)
            else:
                yield ("outlets", name), f"{exc}; an outlet with another name needs a `kind:`"
        except ValidationError as exc:
            for item in exc.errors(include_url=False, include_input=False):
                text = item["msg"].removeprefix("Value error, ")
                yield ("outlets", name, *item["loc"]), text
