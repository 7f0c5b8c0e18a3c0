"""Locate, unpack and parse the GenICam description of a camera.

A description comes over the network, so its size and depth are bounded, and a document type, which
could define entities, is refused.

Source: GigE Vision 2.0, chapter 12.1 (URLs, ZIP); GenApi 2.0, chapter 2.8 (XML).
"""

from __future__ import annotations

import io
import re
import zipfile
import zlib
from typing import Final, NamedTuple
from xml.parsers import expat

from smartcam.exceptions import MessageError

MAX_PLAIN_BYTES: Final = 16 << 20
"""Largest size of an unpacked description, bytes; descriptions of large cameras have 2 MB."""

MAX_PACKED_BYTES: Final = 4 << 20
"""Largest size of a description's ZIP archive, bytes; 2 MB of XML are packed in 0.2 MB. It also
bounds the number of files to list: an archive declares one in 46 bytes, listing it takes 8 us."""

MAX_LEVELS: Final = 32
"""Largest depth of nested elements of a description."""

MAX_ELEMENTS: Final = 400_000
"""Largest number of elements of a description; those of a ``StructReg`` count for each of its
entries."""


class Location(NamedTuple):
    """The file name and the address of a description in the camera's memory.

    Attributes:
        name: name of the file, with the suffix ``.zip`` if the file is packed.
        address: address of the first byte.
        length: number of bytes.
    """

    name: str
    address: int
    length: int


class Element:
    """An element of a description.

    Attributes:
        kind: tag of the element.
        name: value of the attribute ``Name``, or "".
        attributes: all attributes by name.
        children: elements inside of this one, in document order.
        text: text inside of the element, without blanks at its ends.
    """

    __slots__ = ("attributes", "children", "kind", "name", "text")

    def __init__(self, kind: str, attributes: dict[str, str]) -> None:
        self.kind, self.attributes = kind, attributes
        self.name = attributes.get("Name", "")
        self.children: list[Element] = []
        self.text = ""

    def all(self, *kinds: str) -> list[Element]:
        """Return the children of these kinds."""
        return [child for child in self.children if child.kind in kinds]

    def first(self, *kinds: str) -> Element | None:
        """Return the first child of these kinds."""
        return next((child for child in self.children if child.kind in kinds), None)

    def text_of(self, kind: str, default: str = "") -> str:
        """Return the text of the first child of a kind."""
        child = self.first(kind)
        return default if child is None else child.text


def locate(url: str) -> Location:
    """Parse the URL of a description: ``Local:name.zip;ADDRESS;LENGTH``, both hexadecimal.

    Raises:
        MessageError: the URL has another form, or impossible numbers.
    """
    match = re.fullmatch(
        r"local:/*([^;]*);\s*(?:0x)?([0-9a-f]{1,8});\s*(?:0x)?([0-9a-f]{1,8})(?:\?.*)?",
        url.strip(),
        re.IGNORECASE,
    )
    if match is None:
        raise MessageError(f"expected 'Local:NAME;ADDRESS;LENGTH', got {url[:80]!r}")
    location = Location(match[1], int(match[2], 16), int(match[3], 16))
    if not 0 < location.length <= MAX_PLAIN_BYTES:
        raise MessageError(
            f"{url[:80]!r}: expected 1 to {MAX_PLAIN_BYTES} bytes, got {location.length}"
        )
    return location


def unpack(data: bytes) -> bytes:
    """Return a description's text, from a ZIP archive the text of its first XML file.

    Raises:
        MessageError: the archive cannot be unpacked, has more than :data:`MAX_PLAIN_BYTES`, or is
            not compressed by DEFLATE; with other methods a few bytes may unpack to gigabytes.
    """
    if not data.startswith(b"PK"):
        return data.rstrip(b"\0")
    if len(data) > MAX_PACKED_BYTES:
        raise MessageError(
            f"the description's ZIP archive: expected at most {MAX_PACKED_BYTES} bytes, got "
            f"{len(data)}"
        )
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = sorted(archive.namelist(), key=lambda name: not name.lower().endswith(".xml"))
            if not names:
                raise MessageError("the description's ZIP archive is empty")
            method = archive.getinfo(names[0]).compress_type
            if method not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise MessageError(
                    f"the description's ZIP archive: expected DEFLATE (8) or no compression (0), "
                    f"got method {method}"
                )
            with archive.open(names[0]) as file:
                text = file.read(MAX_PLAIN_BYTES + 1)
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        NotImplementedError,
        RuntimeError,
        OSError,
        ValueError,
    ) as exc:
        raise MessageError(f"the description's ZIP archive cannot be read: {exc}") from exc
    if len(text) > MAX_PLAIN_BYTES:
        raise MessageError(f"the description unpacks to more than {MAX_PLAIN_BYTES} bytes")
    return text


def parse(text: bytes) -> dict[str, Element]:
    """Return a description's nodes by their names.

    Raises:
        MessageError: the text is no XML, has a document type, or exceeds a bound.
    """
    reader = _XmlReader()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.characters
    parser.StartDoctypeDeclHandler = reader.doctype
    try:
        parser.Parse(text, True)
    except (expat.ExpatError, ValueError, LookupError) as exc:
        raise MessageError(f"the description is no XML: {exc}", data=text) from exc
    if reader.root.kind != "RegisterDescription":
        raise MessageError(
            f"the description: expected <RegisterDescription>, got <{reader.root.kind[:40]}>"
        )
    return _nodes(reader.root)


class _XmlReader:
    def __init__(self) -> None:
        self.root = Element("", {})
        self._open: list[Element] = []
        self._texts: list[list[str]] = []  # pieces of the text of each open element
        self._count = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if len(self._open) >= MAX_LEVELS or self._count > MAX_ELEMENTS:
            raise MessageError(
                f"the description: expected at most {MAX_ELEMENTS} elements in {MAX_LEVELS} levels"
            )
        element = Element(tag.rpartition(":")[2], attributes)
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)
        self._texts.append([])

    def end(self, _: str) -> None:
        self._open.pop().text = "".join(self._texts.pop()).strip()

    def characters(self, text: str) -> None:
        if self._texts:
            self._texts[-1].append(text)

    def doctype(self, *_: object) -> None:
        raise MessageError("the description has a document type, which is not read")


def _nodes(root: Element) -> dict[str, Element]:
    """Return the named elements; each entry of a StructReg also gets the StructReg's elements."""
    nodes: dict[str, Element] = {}
    pending, copies = [root], 0
    while pending:
        element = pending.pop()
        if element.kind in ("RegisterDescription", "Group"):
            pending += element.children
        elif element.kind == "StructReg":
            shared = [child for child in element.children if child.kind != "StructEntry"]
            for entry in element.all("StructEntry"):
                copies += len(shared)
                if copies > MAX_ELEMENTS:
                    raise MessageError(
                        f"the description: expected at most {MAX_ELEMENTS} elements, got {copies} "
                        "copies for the entries of StructRegs"
                    )
                own_kinds = {child.kind for child in entry.children}
                entry.children += [node for node in shared if node.kind not in own_kinds]
                nodes[entry.name] = entry
        elif element.name:
            nodes[element.name] = element
    return nodes
