"""Read layouts from classes, whose annotations give each field's encoding on the wire.

::

    @dataclass
    class Measured:
        passed: bool                                  # a bool needs no layout text
        x: Annotated[float, "real32 mm"]
        parts: Annotated[list[Part], "*"]             # a group: records of another class

The texts are joined and parsed like any layout text, so that only one module knows which layouts
are valid.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    NamedTuple,
    TypeAlias,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from smartcam.exceptions import InterpretationError, LayoutError
from smartcam.layout._text import Field, LayoutSpec, parse_text, to_text

if TYPE_CHECKING:
    from pydantic import BaseModel
    from typing_extensions import TypeIs

Make: TypeAlias = Callable[[Any], Any]
"""Function that makes objects of the class from the values of a layout's ``parse``."""


class ClassLayout(NamedTuple):
    """The layout of a container that a class describes.

    Attributes:
        text: the layout text.
        make: function that makes objects of the class from the values of that layout's ``parse``.
    """

    text: str
    make: Make


class _Member(NamedTuple):
    name: str
    hint: Any  # the annotation without its layout text
    text: str | None


def describes_layout(described: object) -> bool:
    """Return True for a class whose fields can describe a layout, or a list of such a class."""
    return _is_record(described) or _list_item(described) is not None


@functools.lru_cache(maxsize=128)
def read_class(described: Any) -> ClassLayout:
    """Return the layout that a class, or a list of one, describes.

    Raises:
        LayoutError: the layout text of a field is missing, is wrong, or does not match its type.
    """
    record = _list_item(described)
    if record is None and not _is_record(described):
        raise LayoutError(
            "layout: expected a dataclass, a pydantic model or a NamedTuple, or a list of one, "
            f"got {described!r:.200}"
        )
    if record is None:
        return _read_record(described)
    repeat = next((text for text in _metadata(described) if isinstance(text, str)), "*")
    item_layout = _read_record(record, nested=True)
    return ClassLayout(
        _canonical_text(record, f"({item_layout.text}){repeat}"), _make_list(item_layout.make)
    )


def _read_record(described: type, *, nested: bool = False) -> ClassLayout:
    fields: list[str] = []
    group: ClassLayout | None = None
    members = _members(described)
    for member in members:
        record = _list_item(member.hint)
        if record is None:
            fields.append(str(_read_field(described, member)))
        elif nested or member is not members[-1]:
            problem = "groups do not nest" if nested else "a list comes last"
            raise _member_error(described, member, f"expected no list here: {problem}")
        else:
            group = _read_record(record, nested=True)
            fields.append(f"{member.name}: ({group.text}){member.text or '*'}")
    if not fields:
        raise LayoutError(
            f"class {described.__name__}: expected a field with a layout text, got none"
        )
    names = [member.name for member in members]
    make_list = None if group is None else _make_list(group.make)
    return ClassLayout(
        _canonical_text(described, ", ".join(fields)),
        _make_constructor(described, names, make_list),
    )


def _members(described: type) -> list[_Member]:
    """Return the fields of a class that its constructor takes, in order."""
    if dataclasses.is_dataclass(described):
        names = [field.name for field in dataclasses.fields(described) if field.init]
    elif _is_model(described):
        names = [*described.model_fields]
    else:
        names = [*cast("Any", described)._fields]
    try:
        hints = get_type_hints(described, include_extras=True)
    except NameError as exc:
        raise LayoutError(
            f"class {described.__name__}: its annotations cannot be resolved: {exc}; "
            "define what they name at the top of the module"
        ) from exc
    members: list[_Member] = []
    for name in names:
        text = next((text for text in _metadata(hints[name]) if isinstance(text, str)), None)
        members.append(_Member(name, _without_metadata(hints[name]), text))
    return members


def _read_field(described: type, member: _Member) -> Field:
    """Return the layout's field for a member of a class."""
    text = member.text
    if text is None:
        if member.hint is not bool:
            raise _member_error(
                described, member, 'expected a layout text, as in Annotated[float, "real32"]'
            )
        text = "bool"
    spec = _parse_class_text(described, f"{member.name}: {text}")
    if spec.repeat is not None or len(spec.fields) != 1:
        raise _member_error(
            described, member, f"expected the layout text of one field, got {text!r}"
        )
    field = spec.fields[0]
    allowed = _allowed_types(field)
    # pydantic converts a model's values to the annotated types
    if not _is_model(described) and member.hint not in (*allowed, Any, object):
        expected = " or ".join(type_.__name__ for type_ in allowed)
        actual = getattr(member.hint, "__name__", member.hint)
        raise _member_error(
            described, member, f"expected the type {expected} for {text!r}, got {actual}"
        )
    return field


def _allowed_types(field: Field) -> tuple[type, ...]:
    """Return the types that may annotate the value of a field."""
    if field.type == "bool":
        return (bool,)
    if field.type == "string":
        return (str,)
    if field.wire.is_integer and field.unit is None:
        return (int, float)
    return (float,)


def _list_item(hint: Any) -> type | None:
    """Return the class of a list's items; None if the annotation is no list of such a class."""
    hint = _without_metadata(hint)
    item = get_args(hint)[0] if get_origin(hint) is list else None
    return item if _is_record(item) else None


def _is_record(described: Any) -> bool:
    """Return True if ``described`` is a class whose fields can describe a layout."""
    if not isinstance(described, type):
        return False
    is_named_tuple = issubclass(described, tuple) and hasattr(described, "_fields")
    return dataclasses.is_dataclass(described) or _is_model(described) or is_named_tuple


def _metadata(hint: Any) -> tuple[Any, ...]:
    return tuple(hint.__metadata__) if get_origin(hint) is Annotated else ()


def _is_model(described: type) -> TypeIs[type[BaseModel]]:
    """Return True if a class is a pydantic model; pydantic is not imported to find out."""
    pydantic = sys.modules.get("pydantic")
    return pydantic is not None and issubclass(described, pydantic.BaseModel)


def _without_metadata(hint: Any) -> Any:
    return hint.__origin__ if get_origin(hint) is Annotated else hint


def _canonical_text(described: type, text: str) -> str:
    """Return the canonical form of a layout text."""
    return to_text(_parse_class_text(described, text))


def _parse_class_text(described: type, text: str) -> LayoutSpec:
    try:
        return parse_text(text)
    except LayoutError as exc:
        raise LayoutError(
            f"class {described.__name__}: {exc}", text=exc.text, position=exc.position
        ) from exc


def _member_error(described: type, member: _Member, problem: str) -> LayoutError:
    return LayoutError(f"class {described.__name__}, field {member.name!r}: {problem}")


# ---------------------------------------------------------------------- objects


def _make_list(make: Make) -> Make:
    return lambda records: [*map(make, records)]


def _make_constructor(described: type, names: list[str], make_list: Make | None) -> Make:
    """Return a function that makes an object from a record; ``make_list`` makes its last field."""
    construct = (
        _model_constructor(described, names)
        if _is_model(described)
        else _plain_constructor(described, names)
    )
    if make_list is None:
        return construct
    return lambda record: construct((*record[:-1], make_list(record[-1])))


def _plain_constructor(described: type, names: list[str]) -> Make:
    needs_keywords = dataclasses.is_dataclass(described) and any(
        field.kw_only for field in dataclasses.fields(described)
    )
    if needs_keywords:
        return lambda values: described(**dict(zip(names, values, strict=True)))
    return lambda values: described(*values)


def _model_constructor(described: type[BaseModel], names: list[str]) -> Make:
    from pydantic import ValidationError

    fields = described.model_fields
    keys = [fields[name].alias or name for name in names]

    def make(values: Any) -> BaseModel:
        try:
            return described.model_validate(dict(zip(keys, values, strict=True)))
        except ValidationError as exc:
            first_error = exc.errors()[0]
            location = ".".join(map(str, first_error["loc"]))
            raise InterpretationError(
                f"{described.__name__}{'.' if location else ''}{location}: {first_error['msg']}, "
                f"got {first_error['input']!r:.80}",
                field=location,
                expected=first_error["msg"],
                got=first_error["input"],
            ) from exc

    return make


def values_of(value: object) -> dict[str, Any] | None:
    """Return the fields of an object of a layout's class by name; None for other objects."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}
    described = type(value)
    if _is_model(described):
        return {name: getattr(value, name) for name in described.model_fields}
    return None
