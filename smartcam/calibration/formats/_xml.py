"""Parse XML of other programs into elements, within bounds and without document types."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final
from xml.parsers import expat

from smartcam.calibration.formats._plain import MAX_DEPTH, Plain, malformed
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_XML_ELEMENTS: Final = 20_000
"""A file has at most this many elements; a robot's description has some hundred."""


@dataclass(slots=True)
class XmlElement:
    """An element of XML.

    Attributes:
        kind: tag of the element.
        attributes: values of the attributes, by their names.
        children: elements inside this one, in their order.
        text: text inside the element, without that of its children.
    """

    kind: str
    attributes: dict[str, str]
    children: list[XmlElement] = field(default_factory=list)
    text: str = ""

    def all(self, kind: str) -> Iterator[XmlElement]:
        """Yield all elements of a kind, at any depth."""
        for child in self.children:
            if child.kind == kind:
                yield child
            yield from child.all(kind)


def load_xml(text: str) -> XmlElement:
    """Return the outermost element of a document.

    Raises ``MALFORMED`` if it is no XML, has a document type, or exceeds a bound.
    """
    root = XmlElement("", {})
    opened, texts = [root], [[""]]
    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MAX_XML_ELEMENTS or len(opened) > MAX_DEPTH:
            raise malformed(
                "file", f"{MAX_XML_ELEMENTS} elements at most, {MAX_DEPTH} in each other"
            )
        element = XmlElement(tag.rpartition(":")[2], attributes)
        opened[-1].children.append(element)
        opened.append(element)
        texts.append([])

    def end(_: str) -> None:
        opened.pop().text = "".join(texts.pop()).strip()

    def doctype(*_: object) -> None:
        raise malformed("file", "XML without a document type")

    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = lambda piece: texts[-1].append(piece)
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(text.encode(), True)
    except CalibrationError:  # also a ValueError
        raise
    except (expat.ExpatError, ValueError) as exc:
        raise malformed("file", f"XML ({exc})") from exc
    return root.children[0]


def storage_data(element: XmlElement) -> Plain:
    """Convert an element of OpenCV's XML storage to the form of its YAML storage."""
    if not element.children:
        listed = element.kind == "data" or " " in " ".join(element.text.split())
        return (
            element.text.split() if listed and '"' not in element.text else element.text.strip('"')
        )
    if all(child.kind == "_" for child in element.children):
        return [storage_data(child) for child in element.children]
    found: dict[str, Plain] = {}
    for child in element.children:
        if child.kind in found:
            raise malformed(element.kind, "each name once", child.kind)
        found[child.kind] = storage_data(child)
    return found
