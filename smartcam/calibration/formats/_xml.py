"""Parse XML of other programs, up to a number of elements, and without document types."""

from __future__ import annotations

from typing import Final
from xml.etree import ElementTree

from smartcam.calibration.formats._plain import MAX_DEPTH, Plain, malformed_error
from smartcam.exceptions import CalibrationError

MAX_XML_ELEMENTS: Final = 20_000
"""Largest number of elements of a file; a robot's description has some hundred."""


class _BoundedBuilder(ElementTree.TreeBuilder):
    """A builder of elements, without their namespaces."""

    def __init__(self) -> None:
        super().__init__()
        self._count = self._depth = 0

    def start(self, tag: str, attributes: dict[str, str], /) -> ElementTree.Element:
        self._count, self._depth = self._count + 1, self._depth + 1
        if self._count > MAX_XML_ELEMENTS or self._depth > MAX_DEPTH:
            raise malformed_error(
                "file", f"{MAX_XML_ELEMENTS} elements at most, nested {MAX_DEPTH} deep at most"
            )
        return super().start(tag.rpartition("}")[2], attributes)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag.rpartition("}")[2])

    def doctype(self, *_: object) -> None:
        raise malformed_error("file", "XML without a document type")


def load_xml(text: str) -> ElementTree.Element:
    """Return the outermost element of a document.

    Raises ``MALFORMED`` if it is no XML, has a document type, or exceeds a bound.
    """
    parser = ElementTree.XMLParser(target=_BoundedBuilder())  # noqa: S314 - no document types
    try:
        parser.feed(text)
        return parser.close()
    except CalibrationError:  # also a ValueError
        raise
    except (ElementTree.ParseError, ValueError) as exc:
        raise malformed_error("file", f"XML ({exc})") from exc


def storage_data(element: ElementTree.Element) -> Plain:
    """Convert an element of OpenCV's XML storage to the form of its YAML storage."""
    if not len(element):
        text = (element.text or "").strip()
        is_list = element.tag == "data" or " " in " ".join(text.split())
        return text.split() if is_list and '"' not in text else text.strip('"')
    if all(child.tag == "_" for child in element):
        return [storage_data(child) for child in element]
    data: dict[str, Plain] = {}
    for child in element:
        if child.tag in data:
            raise malformed_error(element.tag, "each name once", child.tag)
        data[child.tag] = storage_data(child)
    return data
