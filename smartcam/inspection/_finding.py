"""Values: a tool's finding in a picture, and the inspection that holds all of them."""

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
    """The answer of one tool about one picture.

    Attributes:
        ok: the tool's verdict.
        reason: why the verdict is not ok, in one sentence for people; "" if it is.
        values: what was found, by the names of the tool's fields, in SI units (metres, radians,
            pixels). A field that is left out has no value: 0, False, "" or NaN on the wire.
        records: values of each thing found, by the names of the tool's records.
        drawings: marks for people.
        reference: frame of reference that later tools may follow; None: there is none.
        details: what the tool knows beyond its fields, for programs; of the tool's own type.
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
    """The answer of a program about one picture.

    Attributes:
        application: number of the application.
        name: name of the application.
        ok: True if every tool's verdict is.
        reason: why the verdict is not ok: the first tool's reason that is not; "" if all are.
        values: the values of the layout, by field, as :meth:`Layout.build` takes them.
        findings: what each tool found, by its name, in the order they ran.
        seconds: how long each tool took, by its name.
        layout: the layout of the values.
        picture: the picture that was judged.
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
        marks = [mark for found in self.findings.values() for mark in found.drawings]
        verdict = "ok" if self.ok else f"not ok: {self.reason}"
        place = (0.0, 22.0 * stroke_width(*self.picture.size))
        role: Literal["found", "wrong"] = "found" if self.ok else "wrong"
        return (*marks, Drawing("text", (place,), role, f"{self.name}: {verdict}"))

    def payload(self, byte_order: ByteOrder = "little", *, sequence: int | None = None) -> bytes:
        """Return the bytes of the result container.

        Args:
            byte_order: order of the bytes of a number.
            sequence: value of the ``@sequence`` field; None: 0 where the layout has one.

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
        """The values as a client of the camera gets them."""
        value: Record = self.layout.parse(self.payload())
        return value

    def drawn(self) -> NDArray[Any]:
        """Return the picture with the tools' marks, (H, W, 3), uint8, red first.

        Raises:
            MissingExtraError: OpenCV is not installed.
        """
        from smartcam.inspection._drawing import draw

        return draw(self)
