"""Findings of tools, and the inspection that holds the findings of one picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, cast

from smartcam._arguments import check_choice, check_integer
from smartcam._forks import cached_property
from smartcam.frames._inside import Drawing, stroke_width

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.inspection._picture import Picture
    from smartcam.inspection._places import PixelPose
    from smartcam.layout import Layout, Record
    from smartcam.models import ByteOrder


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """The result of one tool for one picture.

    Attributes:
        ok: the tool's verdict.
        reason: why the verdict is not ok, in one sentence; "" if it is ok.
        values: values by the names of the tool's fields, in SI units (metres, radians, pixels). A
            missing field is sent as 0, False, "" or NaN.
        records: values of each found object, by the names of the tool's records.
        drawings: marks to draw.
        reference: frame of reference that later tools may follow; None: no frame.
        details: more results for Python programs, in the tool's own type.
    """

    ok: bool
    reason: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)
    records: Sequence[Mapping[str, Any]] = ()
    drawings: Sequence[Drawing] = ()
    reference: PixelPose | None = None
    details: Any = None


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """The results of a program for one picture.

    Attributes:
        application: number of the application.
        name: name of the application.
        ok: True if the verdict of every tool is ok.
        reason: reason of the first tool that is not ok; "" if all are ok.
        values: values by the fields of the layout, for :meth:`Layout.build`.
        findings: finding of each tool by its name, in running order.
        seconds: duration of each tool by its name.
        layout: the layout of the values.
        picture: the inspected picture.
    """

    application: int
    name: str
    ok: bool
    reason: str
    values: Mapping[str, Any]
    findings: Mapping[str, Finding]
    seconds: Mapping[str, float]
    layout: Layout = field(repr=False)
    picture: Picture = field(repr=False)

    @property
    def drawings(self) -> tuple[Drawing, ...]:
        """The marks of all tools, and the verdict as a text in the upper left corner."""
        marks = [mark for finding in self.findings.values() for mark in finding.drawings]
        verdict = "ok" if self.ok else f"not ok: {self.reason}"
        place = (0.0, 22.0 * stroke_width(*self.picture.size))
        role: Literal["found", "wrong"] = "found" if self.ok else "wrong"
        return (*marks, Drawing("text", (place,), role, f"{self.name}: {verdict}"))

    def payload(self, byte_order: ByteOrder = "little", *, sequence: int | None = None) -> bytes:
        """Return the bytes of the result container.

        Args:
            byte_order: byte order of numbers.
            sequence: value of the ``@sequence`` field; None: 0 if the layout has the field.

        Raises:
            ConfigurationError: an argument is wrong, or the sequence number does not fit its field.
        """
        order = check_choice(byte_order, "byte_order", ("little", "big"), "payload")
        if sequence is not None:
            sequence = check_integer(sequence, "sequence", -(1 << 31), 0xFFFFFFFF, "payload")
        if self.layout.sequence_field is None:
            sequence = None
        return self.layout.build(self.values, cast("ByteOrder", order), sequence=sequence)

    @cached_property
    def value(self) -> Record:
        """Values as a client of the camera receives them."""
        value: Record = self.layout.parse(self.payload())
        return value

    def drawn(self) -> NDArray[Any]:
        """Return the picture with the tools' marks, (H, W, 3), uint8, red first.

        Raises:
            MissingExtraError: OpenCV is not installed.
        """
        from smartcam.inspection._drawing import draw

        return draw(self)
