"""Convert layouts to plain data, YAML and pydantic models; imported only when needed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, RootModel, ValidationError, create_model
from pydantic import Field as ModelField

from smartcam.exceptions import ConfigurationError, LayoutError
from smartcam.layout._text import TYPES, UNITS, LayoutSpec, parse_text, to_text
from smartcam.layout._text import Field as LayoutField
from smartcam.layout._yaml_parsing import BadYamlError, load, yaml_module

if TYPE_CHECKING:
    from collections.abc import Mapping

_Name = Annotated[str, ModelField(pattern=r"^[^\W\d]\w*$", max_length=200)]
_Count = Annotated[int, ModelField(ge=1, le=65_535, strict=True)]


class _FieldData(BaseModel):
    """One field, as in a file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: _Name
    type: str = ModelField(description="type as in a layout text", max_length=200)
    unit: str | None = ModelField(None, description="unit on the wire", max_length=200)
    sequence: bool = ModelField(False, description="carries the sequence number", strict=True)


class _LayoutData(BaseModel):
    """A layout, as in a file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    head: list[_FieldData] = []
    fields_: list[_FieldData] = ModelField(alias="fields", min_length=1)
    repeat: Literal["*"] | _Count | _Name | None = None
    group: _Name | None = None
    lenient: bool = ModelField(False, strict=True)


def to_data(spec: LayoutSpec, *, lenient: bool) -> dict[str, Any]:
    """Return ``spec`` as plain data; entries with their default value are left out."""
    data = _LayoutData.model_construct(
        head=[_field_data(field) for field in spec.head],
        fields_=[_field_data(field) for field in spec.fields],
        repeat=spec.repeat,
        group=spec.group,
        lenient=lenient,
    )
    return data.model_dump(by_alias=True, exclude_defaults=True)


def _field_data(field: LayoutField) -> _FieldData:
    return _FieldData.model_construct(
        name=field.name, type=field.type_text, unit=field.unit, sequence=field.sequence
    )


def from_data(data: Mapping[str, Any]) -> tuple[str, bool]:
    """Return the layout text of plain data, and whether it is lenient.

    The text is built from checked words and then parsed like any other, so that only one module
    knows which layouts are valid. Raises ConfigurationError if there are unknown keys, or values
    that are no words of a layout text.
    """
    try:
        checked = _LayoutData.model_validate(data)
    except ValidationError as exc:
        mistakes = "; ".join(
            f"{'.'.join(map(str, error['loc'])) or 'layout'}: {error['msg']}"
            for error in exc.errors()[:5]
        )
        raise ConfigurationError(f"layout: {mistakes}") from exc
    if checked.repeat is None and (checked.head or checked.group is not None):
        raise ConfigurationError("layout: head and group are for layouts with repeat")
    spec = LayoutSpec(
        tuple(_parse_field(field) for field in checked.head),
        tuple(_parse_field(field) for field in checked.fields_),
        checked.repeat,
        checked.group,
    )
    return to_text(spec), checked.lenient


def _parse_field(data: _FieldData) -> LayoutField:
    type_, _, length = data.type.partition("[")
    digits = length.removesuffix("]")
    if type_ not in TYPES or (length and not (length.endswith("]") and digits.isdecimal())):
        raise ConfigurationError(
            f"layout: field {data.name!r}: expected a type ({', '.join(TYPES)}[n]), "
            f"got {data.type!r}"
        )
    if data.unit is not None and data.unit not in UNITS:
        raise ConfigurationError(
            f"layout: field {data.name!r}: expected a unit ({', '.join(UNITS)}), got {data.unit!r}"
        )
    # the type's text includes the length, whose range the parser of layout texts checks
    return LayoutField(data.name, data.type, None, data.unit, data.sequence)


def dump_yaml(data: dict[str, Any]) -> str:
    """Return plain data as YAML."""
    text: str = yaml_module("layout: YAML").safe_dump(data, sort_keys=False, allow_unicode=True)
    return text


def load_yaml(text: str) -> dict[str, Any] | str:
    """Return the plain data in a YAML document, or the layout text in it.

    Raises LayoutError if it is neither.
    """
    try:
        loaded: Any = load(text, label="layout: YAML")
    except BadYamlError as exc:
        # "x: int32, y: int32" is no YAML; a broken document is no layout text either
        try:
            parse_text(text)
        except LayoutError as error:
            place = "" if exc.line is None else f"line {exc.line}: "
            raise LayoutError(
                f"{error}\nnor is it YAML: {place}{exc}", text=error.text, position=error.position
            ) from exc
        return text
    values: Any = loaded
    if isinstance(loaded, str):
        return loaded
    # "x: int32" is also a YAML mapping, but a layout file has values that are no texts
    is_data = isinstance(loaded, dict) and not all(isinstance(v, str) for v in values.values())
    return values if is_data else text


def make_model(spec: LayoutSpec) -> type[BaseModel]:
    """Return the pydantic model of the values from a layout's ``parse``."""
    record = _make_object_model("Record", [_member_data(field) for field in spec.fields])
    if spec.repeat is None:
        return record
    bounds = {"min_length": spec.repeat, "max_length": spec.repeat}
    limits: dict[str, Any] = bounds if isinstance(spec.repeat, int) else {}
    records: Any = Annotated[list[record], ModelField(**limits)]  # type: ignore[valid-type]
    if spec.is_list:
        return type("Records", (RootModel[records],), {"__module__": __name__})
    members = [_member_data(field) for field in spec.head]
    return _make_object_model(
        "Container", [*members, (spec.group_field, records, "the records", {})]
    )


def _member_data(field: LayoutField) -> tuple[str, Any, str, dict[str, Any]]:
    """Return name, type, description and limits of a field's value."""
    wire, text = field.wire, field.type_text
    if field.sequence:
        text += ", the sequence number"
    if field.type == "bool":
        return field.name, bool, text, {}
    if field.type == "string":
        return field.name, str, text, {"max_length": field.length}
    if field.unit is not None:
        text = f"{UNITS[field.unit].si}; {text} {field.unit} on the wire"
    elif wire.is_integer:
        return field.name, int, text, {"ge": wire.low, "le": wire.high}
    return field.name, float, text, {}


def _make_object_model(
    name: str, members: list[tuple[str, Any, str, dict[str, Any]]]
) -> type[BaseModel]:
    taken = {member[0] for member in members}
    definitions: dict[str, Any] = {}
    for member, type_, description, limits in members:
        attribute = member
        while hasattr(BaseModel, attribute) or (attribute != member and attribute in taken):
            attribute += "_"
        alias = None if attribute == member else member
        definitions[attribute] = (
            type_,
            ModelField(alias=alias, description=description, **limits),
        )
    config = ConfigDict(
        frozen=True, extra="forbid", from_attributes=True, protected_namespaces=(), title=name
    )
    model: type[BaseModel] = create_model(name, __config__=config, **definitions)
    return model
