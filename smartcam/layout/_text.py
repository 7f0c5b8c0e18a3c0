"""Parse and write the layout language.

::

    layout = item { "," item } [ "," ]
    item   = field | group                      one group at most, and it comes last
    field  = name ":" type [ unit ] [ "@sequence" ]
    group  = [ name ":" ] "(" field { "," field } [ "," ] ")" ( "*" | "[" number | name "]" )

White space and new lines have no meaning, ``#`` begins a comment. The parser is a single recursive
descent over a list of tokens; every token has its place, so every mistake can be shown.
"""

from __future__ import annotations

import keyword
import math
import re
import unicodedata
from dataclasses import dataclass
from typing import NamedTuple, NoReturn

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import InterpretationError, LayoutError

MAX_TEXT_CHARACTERS = 20_000
"""A layout text has at most this many characters. A container holds about 64 kB; a thousand fields,
each configured by hand on the camera, still fit."""

MAX_COUNT = 65_535
"""Largest length of a string in bytes, and largest number of records: more than a container of
about 64 kB holds."""

SEQUENCE = "sequence"


class WireType(NamedTuple):
    """The encoding of a type on the wire.

    Attributes:
        code: letter of the type in ``struct``.
        numpy: numpy type without a byte order.
        size: number of bytes; 0 for a string, whose length is in the field.
        low: smallest value of an integer; None for other types.
        high: largest value of an integer; None for other types.
    """

    code: str
    numpy: str
    size: int
    low: int | None = None
    high: int | None = None

    @property
    def is_integer(self) -> bool:
        """True if the type is one of the integers; a bool is not."""
        return self.low is not None

    @property
    def is_number(self) -> bool:
        """True if the type is an integer or a real."""
        return self.is_integer or self.numpy[0] == "f"


def _integers(prefix: str, codes: str, kind: str) -> dict[str, WireType]:
    """Return the integer types of one, two, four and eight bytes."""
    table: dict[str, WireType] = {}
    for code, size in zip(codes, (1, 2, 4, 8), strict=True):
        values = 1 << 8 * size
        low = -(values // 2) if kind == "i" else 0
        table[f"{prefix}{8 * size}"] = WireType(code, f"{kind}{size}", size, low, low + values - 1)
    return table


TYPES: dict[str, WireType] = {
    "bool": WireType("B", "u1", 1),
    **_integers("int", "bhiq", "i"),
    **_integers("uint", "BHIQ", "u"),
    "real32": WireType("f", "f4", 4),
    "real64": WireType("d", "f8", 8),
    "string": WireType("s", "S", 0),
}
"""Every type of the language."""


class Unit(NamedTuple):
    """A unit on the wire: ``value * multiply / divide`` is the value in SI.

    One of the factors is 1, or the product is exact as for ``inch``. So a value is rounded only
    once, and scalars and numpy columns are equal to the last bit.
    """

    quantity: str
    si: str
    multiply: float = 1.0
    divide: float = 1.0


UNITS: dict[str, Unit] = {
    "m": Unit("length", "metres"),
    "mm": Unit("length", "metres", divide=1000.0),
    "um": Unit("length", "metres", divide=1_000_000.0),
    "inch": Unit("length", "metres", multiply=254.0, divide=10_000.0),
    "rad": Unit("angle", "radians"),
    "deg": Unit("angle", "radians", multiply=math.pi / 180.0),
    "percent": Unit("ratio", "0 to 1", divide=100.0),
    "px": Unit("pixels", "pixels"),
    "s": Unit("time", "seconds"),
    "ms": Unit("time", "seconds", divide=1000.0),
}
"""Every unit of the language."""

SI_SYMBOLS: dict[str, str] = {"length": "m", "angle": "rad", "time": "s", "pixels": "px"}
"""The symbols of the SI units that values have, by their quantity; a ratio has none."""

# names of the types in programming languages, for hints in errors
_OTHER_NAMES = {
    "float": "real32",
    "float32": "real32",
    "float64": "real64",
    "double": "real64",
    "int": "int32",
    "str": "string[n]",
    "byte": "uint8",
}


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a layout.

    Attributes:
        name: name of the value.
        type: ``bool``, ``int8`` to ``uint64``, ``real32``, ``real64`` or ``string``.
        length: number of bytes of a string; None for other types.
        unit: unit on the wire, from which the value is converted to SI; None: no conversion.
        sequence: whether the field carries the sequence number (``@sequence``).
    """

    name: str
    type: str
    length: int | None = None
    unit: str | None = None
    sequence: bool = False

    @property
    def size(self) -> int:
        """Number of bytes on the wire."""
        return TYPES[self.type].size if self.length is None else self.length

    @property
    def wire(self) -> WireType:
        """Encoding of the field's type on the wire."""
        return TYPES[self.type]

    @property
    def symbol(self) -> str:
        """Symbol of the value's unit; empty if it has none."""
        return "" if self.unit is None else SI_SYMBOLS.get(UNITS[self.unit].quantity, "")

    @property
    def type_text(self) -> str:
        """The type as it is written, ``string[20]`` with its length."""
        return self.type if self.length is None else f"{self.type}[{self.length}]"

    @property
    def label(self) -> str:
        """Name of the field in errors: ``field 'x' (real32 mm)``."""
        return f"field {self.name!r} ({str(self).partition(': ')[2]})"

    def __str__(self) -> str:
        text = f"{self.name}: {self.type_text}"
        if self.unit is not None:
            text += f" {self.unit}"
        return f"{text} @{SEQUENCE}" if self.sequence else text


class LayoutSpec(NamedTuple):
    """The parsed form of a layout text.

    Attributes:
        head: fields before the group; empty without one.
        fields: fields of a record.
        repeat: None for exactly one record, ``"*"``, a number, or the name of the count field.
        group: name of the group, None without one.
    """

    head: tuple[Field, ...]
    fields: tuple[Field, ...]
    repeat: str | int | None
    group: str | None

    @property
    def is_list(self) -> bool:
        """True if the value is a plain list: an unnamed group, without other values."""
        is_no_value = (field.sequence or field.name == self.repeat for field in self.head)
        return self.repeat is not None and self.group is None and all(is_no_value)

    @property
    def group_field(self) -> str:
        """Name of the list, if the value is a record with a list in it."""
        return self.group or "records"


def to_text(spec: LayoutSpec) -> str:
    """Return the canonical text of ``spec``: one line, single spaces."""
    fields = ", ".join(map(str, spec.fields))
    if spec.repeat is None:
        return fields
    name = f"{spec.group}: " if spec.group is not None else ""
    repeat = "*" if spec.repeat == "*" else f"[{spec.repeat}]"
    return ", ".join([*map(str, spec.head), f"{name}({fields}){repeat}"])


def parse_text(text: str, start: int = 0) -> LayoutSpec:
    """Parse the fields and groups of a layout text from ``start`` on.

    Raises LayoutError with the position of the mistake in ``text``. A text is also too long if its
    canonical form is too long, since copies and files use that form.
    """
    _check_length(text, len(text) - start, start)
    spec = _Parser(text, start).parse()
    _check_length(text, len(to_text(spec)), start, "in its canonical form, ")
    return spec


def _check_length(text: str, length: int, start: int, form: str = "") -> None:
    if length > MAX_TEXT_CHARACTERS:
        raise LayoutError(
            f"layout: {form}expected at most {MAX_TEXT_CHARACTERS} characters, got {length}",
            text=text,
            position=min(start + MAX_TEXT_CHARACTERS, len(text)),
        )


def misfit_error(
    field: Field, offset: int, expected: str, actual: object, where: str = "", more: str = ""
) -> InterpretationError:
    """Return the error for a value that does not match its field.

    ``offset``: offset of the value, bytes from the container's beginning. In the text, ``where``
    precedes the field and ``more`` follows ``expected``.
    """
    return InterpretationError(
        f"{where}{field.label} at offset {offset}: expected {expected}{more}, got {actual}",
        field=field.name,
        offset=offset,
        expected=expected,
        got=actual,
    )


class _Token(NamedTuple):
    kind: str
    text: str
    position: int

    def __str__(self) -> str:
        return "the end" if self.kind == "end" else repr(self.text)


_TOKEN = re.compile(
    r"(?P<space>(?:\s|\#[^\n]*)+)|(?P<name>[^\W\d]\w*)|(?P<number>[0-9]+)|(?P<mark>[:,()\[\]*@])"
)


class _Parser:
    def __init__(self, text: str, start: int) -> None:
        self._text = text
        self._tokens = self._tokenize(start)
        self._index = 0
        self._names: set[str] = set()
        self._has_sequence = False

    def parse(self) -> LayoutSpec:
        """Parse the whole text."""
        fields: list[Field] = []
        group: LayoutSpec | None = None
        while True:
            token = self._peek()
            if token.kind == "end" and (fields or group):
                break
            if group is not None:
                self._fail_unexpected("the end, a group comes last")
            if self._is_group_next():
                group = self._parse_group(tuple(fields))
            else:
                fields.append(self._parse_field("a field or a group"))
            if not self._accept_mark(","):
                self._expect_end(None if group else fields[-1])
                break
        return group or LayoutSpec((), tuple(fields), None, None)

    # -- rules -------------------------------------------------------------------------------

    def _is_group_next(self) -> bool:
        """Return True if the next tokens are ``(`` or ``name : (``."""
        next_texts = [token.text for token in self._tokens[self._index : self._index + 3]]
        return next_texts[:1] == ["("] or next_texts[1:] == [":", "("]

    def _parse_group(self, head: tuple[Field, ...]) -> LayoutSpec:
        first_token = self._peek()
        name: str | None = None
        if first_token.text != "(":
            name = self._parse_name("a field or a group")
            self._next_token()
        self._next_token()
        fields: list[Field] = []
        while not (fields and self._peek().text == ")"):
            if self._is_group_next():
                self._fail("expected a field, groups do not nest", self._peek())
            fields.append(self._parse_field("a field"))
            if not self._accept_mark(","):
                break
        if not self._accept_mark(")"):
            self._fail_after(fields[-1], "',' or ')'")
        spec = LayoutSpec(head, tuple(fields), self._parse_repeat(head), name)
        if not spec.is_list and any(field.name == spec.group_field for field in head):
            self._fail(
                "expected a name before the group, 'records' is a field already", first_token
            )
        return spec

    def _parse_repeat(self, head: tuple[Field, ...]) -> str | int:
        if self._accept_mark("*"):
            return "*"
        self._expect_mark("[", "'*', '[number]' or '[name]' after the group")
        token = self._next_token()
        repeat: str | int
        if token.kind == "number":
            repeat = self._parse_number(token, "records")
        elif token.kind == "name":
            repeat = self._parse_count_name(token, head)
        else:
            self._fail_unexpected("a number or the name of a count field", token)
        self._expect_mark("]", "']'")
        return repeat

    def _parse_count_name(self, token: _Token, head: tuple[Field, ...]) -> str:
        name = unicodedata.normalize("NFKC", token.text)
        for field in head:
            if field.name == name:
                break
        else:
            known = ", ".join(field.name for field in head) or "none"
            self._fail_unexpected(f"the name of a field before the group (there: {known})", token)
        if not field.wire.is_integer or field.unit is not None or field.sequence:
            self._fail(
                f"expected an integer field without a unit as the count, got {field.label}", token
            )
        return name

    def _parse_field(self, expected: str) -> Field:
        name = self._parse_name(expected)
        self._expect_mark(":", f"':' and a type after {name!r}")
        type_, length = self._parse_type()
        unit = self._parse_unit(type_)
        return Field(name, type_, length, unit, self._parse_sequence(type_, unit))

    def _parse_name(self, expected: str) -> str:
        token = self._next_token()
        if token.kind != "name":
            self._fail_unexpected(expected, token)
        # normalized, as Python does with the names of attributes
        name = unicodedata.normalize("NFKC", token.text)
        if not token.text.isidentifier() or name.startswith("_") or keyword.iskeyword(name):
            self._fail_unexpected(
                "a name that can be an attribute (letters, digits, '_'; no leading '_', no Python "
                "keyword)",
                token,
            )
        if name in self._names:
            self._fail(f"expected a new name, {name!r} is there already", token)
        self._names.add(name)
        return name

    def _parse_type(self) -> tuple[str, int | None]:
        token = self._next_token()
        if token.text not in TYPES:
            self._fail(
                f"expected a type ({', '.join(TYPES)}), got {token}"
                f"{did_you_mean(token.text, TYPES, _OTHER_NAMES)}",
                token,
            )
        if token.text != "string":
            return token.text, None
        self._expect_mark("[", "'[' and the string's length in bytes")
        length = self._parse_number(self._next_token(), "bytes")
        self._expect_mark("]", "']'")
        return token.text, length

    def _parse_unit(self, type_: str) -> str | None:
        token = self._peek()
        if token.kind != "name" or self._peek_second().text == ":":
            return None
        if not TYPES[type_].is_number:
            self._fail_unexpected(f"no unit, a {type_} has none")
        if token.text not in UNITS:
            self._fail_unexpected(f"a unit ({', '.join(UNITS)})")
        return self._next_token().text

    def _parse_sequence(self, type_: str, unit: str | None) -> bool:
        mark = self._peek()
        if not self._accept_mark("@"):
            return False
        if self._peek().text != SEQUENCE:
            self._fail(f"expected '@{SEQUENCE}', got '@' and {self._peek()}", mark)
        self._next_token()
        if not TYPES[type_].is_integer or unit is not None:
            self._fail(f"expected '@{SEQUENCE}' only after an integer without a unit", mark)
        if self._has_sequence:
            self._fail(f"expected one '@{SEQUENCE}', got a second", mark)
        self._has_sequence = True
        return True

    def _parse_number(self, token: _Token, counted: str) -> int:
        digits = token.text.lstrip("0")
        # check the length first: int() refuses some thousand digits with an error of its own
        if token.kind != "number" or not 1 <= len(digits) <= 5 or int(digits) > MAX_COUNT:
            self._fail_unexpected(f"a number of {counted} from 1 to {MAX_COUNT}", token)
        return int(digits)

    def _expect_end(self, last: Field | None) -> None:
        if self._peek().kind == "end":
            return
        if last is None:
            self._fail_unexpected("the end, a group comes last")
        self._fail_after(last, "',' or the end")

    # -- tokens ------------------------------------------------------------------------------

    def _tokenize(self, start: int) -> list[_Token]:
        tokens: list[_Token] = []
        position = start
        while position < len(self._text):
            match = _TOKEN.match(self._text, position)
            if match is None:
                character = self._text[position]
                self._fail(
                    f"expected a name, a number or one of : , ( ) [ ] * @ #, got {character!r}",
                    _Token("mark", character, position),
                )
            if match.lastgroup != "space":
                tokens.append(_Token(match.lastgroup or "", match.group(), position))
            position = match.end()
        tokens.append(_Token("end", "", max(start, len(self._text))))
        return tokens

    def _peek(self) -> _Token:
        return self._tokens[self._index]

    def _peek_second(self) -> _Token:
        return self._tokens[min(self._index + 1, len(self._tokens) - 1)]

    def _next_token(self) -> _Token:
        token = self._tokens[self._index]
        if token.kind != "end":
            self._index += 1
        return token

    def _accept_mark(self, mark: str) -> bool:
        if self._peek().kind == "mark" and self._peek().text == mark:
            self._index += 1
            return True
        return False

    def _expect_mark(self, mark: str, expected: str) -> None:
        if not self._accept_mark(mark):
            self._fail_unexpected(expected)

    def _fail_unexpected(self, expected: str, token: _Token | None = None) -> NoReturn:
        """Raise the error for a token, by default the next one."""
        token = token or self._peek()
        self._fail(f"expected {expected}, got {token}", token)

    def _fail_after(self, field: Field, expected: str) -> NoReturn:
        """Raise the error for a token after a complete field; name the parts that may follow."""
        token = self._peek()
        if token.kind == "name":
            self._fail(f"expected {expected}, got {token}: a comma is missing before it", token)
        extras = "" if field.unit or not field.wire.is_number else "a unit, "
        self._fail_unexpected(f"{extras}{expected}")

    def _fail(self, message: str, token: _Token) -> NoReturn:
        at = token.position
        raise LayoutError(
            f"layout: {message} {_show_position(self._text, at)}", text=self._text, position=at
        )


def _show_position(text: str, position: int) -> str:
    """Return the line of ``position`` with a caret below it."""
    before = text[:position]
    line = before.count("\n") + 1
    line_start = before.rfind("\n") + 1
    end = text.find("\n", position)
    column = position - line_start
    place = (
        f"at character {position}" if "\n" not in text else f"at line {line}, column {column + 1}"
    )
    content = text[line_start : end if end >= 0 else len(text)]
    excerpt_start = max(0, column - 50)  # only a part of the line if it is long
    excerpt = "".join(
        char if char.isprintable() else " " for char in content[excerpt_start : column + 30]
    )
    return f"{place}\n  {excerpt}\n  {' ' * (column - excerpt_start)}^"
