"""The tool `read` and its settings."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from smartcam.exceptions import ConfigurationError
from smartcam.frames._inside import Drawing
from smartcam.inspection._finding import Finding
from smartcam.inspection._places import PixelPose
from smartcam.inspection._read.codes import ReadCode, formats_of, read_codes
from smartcam.inspection._read.ladder import CodeSearch, read_again
from smartcam.inspection._read.patterns import MatchTimeoutError, TextPattern
from smartcam.inspection._tool import Tool, ToolSettings

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from smartcam.inspection._tool import ToolSetup, View

MAX_CODES: Final = 255
"""Largest number of codes in one result, which is zxing-cpp's limit."""

MAX_TEXT_BYTES: Final = 4000
"""Largest number of bytes of a code's text; codes hardly hold more."""

INPUT_SETTING: Final = "input"
"""Value of the setting ``expect`` for codes that must equal the trigger's input."""


def _check_pattern(given: str | None) -> str | None:
    if given is not None and given != INPUT_SETTING:
        TextPattern(given)  # raises a ValueError
    return given


class ReadSettings(ToolSettings):
    """Kinds and number of codes, and their expected text."""

    codes: Annotated[
        tuple[str, ...],
        BeforeValidator(lambda given: (given,) if isinstance(given, str) else given),
    ] = Field((), description="kinds such as DataMatrix, Code128, QRCode, EAN13; default: all")
    expect: Annotated[str | None, AfterValidator(_check_pattern)] = Field(
        None,
        max_length=1000,
        description="expected text: a regular expression, or the word input: the trigger's input",
    )
    most: int = Field(1, ge=1, le=MAX_CODES, description="largest number of codes in the result")
    least: int = Field(1, ge=0, le=MAX_CODES, description="least number of codes")
    length: int = Field(64, ge=1, le=MAX_TEXT_BYTES, description="bytes of a text in the result")
    corners: bool = Field(False, description="add the four corners to the result")
    seconds: float = Field(
        0.5,
        ge=0,
        le=60,
        description="time to retry after a miss with differently prepared pictures",
    )


_CORNERS: Final = ("x1", "y1", "x2", "y2", "x3", "y3", "x4", "y4")


class ReadTool(Tool[ReadSettings]):
    """Read codes."""

    settings_model = ReadSettings
    needs_whole_region = False  # a code that can be read is complete

    def __init__(self, settings: ReadSettings, setup: ToolSetup) -> None:
        super().__init__(settings, setup)
        if settings.least > settings.most:
            raise ConfigurationError(f"least: expected up to {settings.most}, as most is")
        try:
            self._formats = formats_of(settings.codes)
        except ValueError as exc:
            raise ConfigurationError(str(exc)) from exc
        expect = settings.expect
        self._pattern = None if expect in (None, INPUT_SETTING) else TextPattern(str(expect))

    @property
    def fields(self) -> str:
        """Fields of the number of codes and of the first code."""
        return f"count: uint8, {self._code_fields}" if self.settings.most == 1 else "count: uint8"

    @property
    def records(self) -> str:
        """Fields of each code."""
        return "" if self.settings.most == 1 else self._code_fields

    @property
    def _code_fields(self) -> str:
        text = f"text: string[{self.settings.length}], kind: string[20], "
        text += "x: real32 px, y: real32 px, angle: real32 deg, unused_correction: real32"
        if self.settings.corners:
            text += "".join(f", {name}: real32 px" for name in _CORNERS)
        return text

    def inspect(self, view: View) -> Finding:
        """Return the codes in the region."""
        settings = self.settings
        grey = np.ascontiguousarray(view.grey)
        region = view.region
        codes = self.read(grey, view.origin, lambda code: region.contains(code.centre))
        reason = self._reason(codes, view.input)
        codes_in_layout = [code for code in codes if self._fits_layout(code)][: settings.most]
        values = [self._values(code) for code in codes_in_layout]
        single_values = values[0] if values and settings.most == 1 else {}
        return Finding(
            ok=not reason,
            reason=reason,
            values={"count": len(codes), **single_values},
            records=values if settings.most > 1 else [],
            drawings=[
                Drawing(
                    "polygon",
                    tuple((float(x), float(y)) for x, y in view.region.corners),
                    "region",
                ),
                *(
                    Drawing("polygon", code.corners, "wrong" if reason else "found", code.text[:40])
                    for code in codes
                ),
            ],
            reference=PixelPose(*codes[0].centre, codes[0].angle) if codes else None,
            details=tuple(codes),
        )

    def read(
        self,
        grey: NDArray[np.uint8],
        origin: tuple[int, int] = (0, 0),
        is_in_region: Callable[[ReadCode], bool] = lambda _: True,
    ) -> list[ReadCode]:
        """Return the codes, from top to bottom.

        Args:
            grey: the picture, (H, W), contiguous.
            origin: place of the first pixel of ``grey`` in the picture to which corners refer.
            is_in_region: function that returns whether a code lies in the region.
        """
        started = time.monotonic()
        to_picture = np.array([[1.0, 0, origin[0]], [0, 1, origin[1]]])
        codes = [code for code in read_codes(grey, self._formats, to_picture) if is_in_region(code)]
        if len(codes) < self.settings.least and self.settings.seconds:
            duration = time.monotonic() - started
            deadline = started + self.settings.seconds
            codes = read_again(
                CodeSearch(grey, self._formats, origin, is_in_region),
                codes,
                self.settings.least,
                deadline,
                duration,
            )
        return sorted(codes, key=lambda code: (code.centre[1], code.centre[0]))

    def _reason(self, codes: list[ReadCode], input_data: bytes) -> str:
        """Return the reason why the codes are not ok; "" if they are ok."""
        settings = self.settings
        if len(codes) < settings.least:
            return f"{len(codes)} codes, expected {settings.least}"
        for code in codes:
            if settings.expect == INPUT_SETTING and code.data != input_data:
                return f"read {code.data[:40]!r}, expected the input {input_data[:40]!r}"
            if not self._fits_layout(code):
                size = len(code.text.encode())
                if size <= settings.length:
                    return "the text contains a NUL character"
                return f"the text has {size} bytes, expected up to {settings.length}"
            if self._pattern is not None:
                try:
                    fits = self._pattern.fits(code.text)
                except MatchTimeoutError:
                    return f"comparing {code.text[:40]!r} with expect takes too long"
                if not fits:
                    return f"read {code.text[:40]!r}, expected {settings.expect}"
        return ""

    def _fits_layout(self, code: ReadCode) -> bool:
        return len(code.text.encode()) <= self.settings.length and "\0" not in code.text

    def _values(self, code: ReadCode) -> Mapping[str, Any]:
        x, y = code.centre
        values: dict[str, Any] = {
            "text": code.text,
            "kind": code.kind,
            "x": x,
            "y": y,
            "angle": code.angle,
        }
        if code.unused_correction is not None:
            values["unused_correction"] = code.unused_correction
        if self.settings.corners:
            values |= zip(
                _CORNERS,
                (coordinate for corner in code.corners for coordinate in corner),
                strict=True,
            )
        return values
