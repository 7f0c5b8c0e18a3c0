"""Messages and services of a distribution of ROS 2: their fields, bytes and hashes."""

from __future__ import annotations

import functools
import struct
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from smartcam._forks import cached_property, notify_of_forks
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError, RosMessageError
from smartcam.ros2._types.built_in import MESSAGES, SERVICES
from smartcam.ros2._types.codec import ENCAPSULATION, MisfitError, decoder, encoder
from smartcam.ros2._types.definitions import (
    Definition,
    MessageField,
    dds_name,
    parse_message,
    parse_service,
    split_name,
    without_defaults,
)
from smartcam.ros2._types.hash import (
    NOT_SUPPORTED,
    describe_with_nested,
    event_definition,
    hash_of_description,
    service_definition,
)
from smartcam.ros2._types.stores import (
    MISSING_BUILT_INS,
    WITHOUT_HASHES,
    read_stored,
    stored_fields,
)
from smartcam.ros2._types.values import (
    LocatedError,
    check_message,
    fill_message,
    message_class,
    value_rule,
    zero_maker,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.ros2._types.values import RosMessage

_ORDERS: Final = {b"\0\1": "<", b"\0\0": ">"}
_MISFIT_ERRORS: Final = (
    MisfitError,
    struct.error,
    KeyError,
    IndexError,
    TypeError,
    ValueError,
    OverflowError,
    AttributeError,
)
"""Errors that encoding and decoding raise if a message or its bytes do not fit."""


class MessageType:
    """A type of message; created by ``RosTypes.message`` and ``RosTypes.service``.

    Attributes:
        name: name of the type, such as ``std_msgs/msg/String``.
        dds: name of the type in keys, such as ``std_msgs::msg::dds_::String_``.
        fields: name, type, shape, bounds and default of each field.
        constants: constants by name; they are attributes of ``cls``, too.
        nested: the nested types by name.
        cls: the class of the messages. Creating one with all fields in their order is the fastest
            way; values are checked when the message is encoded.
    """

    def __init__(
        self, definition: Definition, nested: Mapping[str, MessageType], types: RosTypes
    ) -> None:
        self.name: str = definition.name
        self.dds: str = dds_name(definition.name)
        self.fields: tuple[MessageField, ...] = definition.fields
        self.constants: dict[str, Any] = dict(definition.constants)
        self.nested = nested
        self.cls: type[RosMessage] = message_class(definition)
        self._definition = definition
        self._types = types

    def __repr__(self) -> str:
        return f"<MessageType {self.name}>"

    @cached_property
    def hash(self) -> str:
        """``RIHS01_`` and 64 digits, or ``TypeHashNotSupported``."""
        return self._types.hash_of(self._definition)

    @cached_property
    def description(self) -> dict[str, Any]:
        """The fields of ``type_description_interfaces/msg/TypeDescription``."""
        return describe_with_nested(self._definition, self._types.definition)

    @cached_property
    def text(self) -> str:
        """The definitions of the type and of all nested types in recordings' form (``ros2msg``)."""
        full_description = describe_with_nested(self._definition, self._types.definition)
        parts = [self._definition.text()]
        for referenced in full_description["referenced_type_descriptions"]:
            name: str = referenced["type_name"]
            head = f"{'=' * 80}\nMSG: {name.replace('/msg/', '/')}\n"
            parts.append(head + self._types.definition(name).text())
        return "".join(parts)

    @cached_property
    def zero(self) -> Callable[[], RosMessage]:
        """The function that creates a message of defaults and zeros."""
        return zero_maker(self)

    @cached_property
    def rules(self) -> dict[str, tuple[MessageField, Callable[[Any], Any]]]:
        """Field by its name in Python, with the function that checks and converts a value."""
        return {field.attribute: (field, value_rule(self, field)) for field in self.fields}

    @cached_property
    def _encode(self) -> Callable[[Any], bytes]:
        return encoder(self)

    @cached_property
    def _decoders(self) -> dict[str, Callable[[Any], tuple[Any, int]]]:
        return {}

    def new(self, /, **fields: Any) -> Any:
        """Return a message of these fields; other fields have their default, or zero.

        A nested message may be given as a mapping of its fields.

        Raises:
            RosMessageError: there is no such field, or a value does not fit.
        """
        return self._fill(fields)

    def encode(self, message: Any) -> bytes:
        """Return a message, or a mapping of its fields, in CDR: little-endian, with encapsulation.

        Raises:
            RosMessageError: the value is of another type, or a field does not fit.
        """
        if isinstance(message, Mapping):
            message = self._fill(message)
        elif getattr(message, "__msgtype__", None) != self.name:
            actual = getattr(message, "__msgtype__", type(message).__name__)
            raise RosMessageError(f"{self.name}: expected a message of this type, got {actual}")
        try:
            return self._encode(message)
        except _MISFIT_ERRORS as exc:
            raise RosMessageError(f"{self.name}: {self._find_misfit(message) or exc}") from exc

    def _as_flat_bytes(self, data: object) -> memoryview:
        """Return the contents of a bytearray or memoryview as a flat view of bytes."""
        if not isinstance(data, bytearray | memoryview):
            raise RosMessageError(f"{self.name}: expected bytes, got {type(data).__name__}")
        view = memoryview(data)
        return view.cast("B") if view.c_contiguous else memoryview(view.tobytes())

    def _fill(self, fields: Mapping[str, Any]) -> Any:
        try:
            return fill_message(self, fields)
        except LocatedError as exc:
            raise RosMessageError(f"{self.name}: {exc}") from exc

    def _find_misfit(self, message: Any) -> str:
        try:
            check_message(self, message)
        except LocatedError as exc:
            return str(exc)
        return ""

    def decode(self, data: bytes | bytearray | memoryview, *, whole: bool = True) -> Any:
        """Decode a message of CDR, little- or big-endian.

        Sequences of numbers are views of ``data``, read-only if ``data`` is bytes.

        Args:
            data: bytes of the message.
            whole: True if the message has to fill the bytes, except for up to 3 zeros of padding;
                ROS' own serializer may add further bytes with any contents.

        Raises:
            RosMessageError: the bytes are not such a message, or too few, or too many.
        """
        if not isinstance(data, bytes):
            data = self._as_flat_bytes(data)
        order = _ORDERS.get(bytes(data[:2]))
        if order is None or len(data) < len(ENCAPSULATION):
            raise RosMessageError(
                f"{self.name}: expected CDR with its encapsulation 00 01 or 00 00, got "
                f"{len(data)} bytes: {bytes(data[:4]).hex(' ') or 'none'}"
            )
        decode = self._decoders.get(order)
        if decode is None:
            decode = self._decoders[order] = decoder(self, order)
        try:
            message, end = decode(data)
        except _MISFIT_ERRORS as exc:
            raise RosMessageError(
                f"{self.name}: {len(data)} bytes are no such message: {exc}"
            ) from exc
        extra = len(data) - end
        if whole and extra and (extra > 3 or len(data) % 4 or any(data[end:])):
            raise RosMessageError(
                f"{self.name}: expected {end} bytes, got {len(data)}: {extra} follow the message"
            )
        return message


class ServiceType:
    """A type of service; created by ``RosTypes.service``.

    Attributes:
        name: name of the type, such as ``std_srvs/srv/Trigger``.
        dds: name of the type in keys, such as ``std_srvs::srv::dds_::Trigger_``.
        request: type of the requests.
        response: type of the responses.
    """

    def __init__(self, name: str, types: RosTypes) -> None:
        self.name = name
        self.dds: str = dds_name(name)
        self.request: MessageType = types.message_of(f"{name}_Request")
        self.response: MessageType = types.message_of(f"{name}_Response")
        self._types = types

    def __repr__(self) -> str:
        return f"<ServiceType {self.name}>"

    @cached_property
    def hash(self) -> str:
        """``RIHS01_`` and 64 digits, or ``TypeHashNotSupported``."""
        return self._types.hash_of(service_definition(self.name))

    @cached_property
    def description(self) -> dict[str, Any]:
        """The fields of ``type_description_interfaces/msg/TypeDescription``."""
        return describe_with_nested(service_definition(self.name), self._types.definition)

    @cached_property
    def event(self) -> MessageType:
        """Type of the messages that introspection publishes.

        Raises:
            ConfigurationError: the distribution has no introspection.
        """
        return self._types.message_of(f"{self.name}_Event")


class RosTypes:
    """The messages and services of a distribution of ROS 2, and added ones.

    All objects of a distribution share the distribution's own types; an added type is known only
    to the object to which it was added. The object may be used from any thread.

    Args:
        distribution: ``humble``, ``jazzy``, ``kilted``, ``lyrical`` or ``rolling``.

    Raises:
        ConfigurationError: there is no such distribution.
        MissingExtraError: the extra ``ros2`` is not installed.
    """

    def __init__(self, distribution: str = "jazzy") -> None:
        self.distribution = distribution
        self._stored = stored_fields(distribution)
        self._shared = None if isinstance(self, _Shared) else _shared(distribution)
        self._lock = threading.RLock()
        self._definitions: dict[str, Definition] = {}
        self._added: dict[str, str] = {}
        self._messages: dict[str, MessageType] = {}
        self._services: dict[str, ServiceType] = {}
        notify_of_forks(self)

    def on_fork(self) -> None:
        """Take a new lock: another thread may have held the old one when this process forked."""
        self._lock = threading.RLock()

    def __repr__(self) -> str:
        return f"<RosTypes {self.distribution}>"

    def names(self) -> list[str]:
        """Return the names of all messages and services, sorted."""
        missing = MISSING_BUILT_INS.get(self.distribution, frozenset())
        return sorted({*self._stored, *MESSAGES, *SERVICES, *self._added} - missing)

    def message(self, name: str) -> MessageType:
        """Return a type of message, such as ``std_msgs/msg/String``.

        Raises:
            ConfigurationError: there is no message of this name, or a nested one is not known.
        """
        if (cached := self._messages.get(name)) is not None:
            return cached
        split_name(name, "msg")
        return self.message_of(name)

    def service(self, name: str) -> ServiceType:
        """Return a type of service, such as ``std_srvs/srv/Trigger``.

        Raises:
            ConfigurationError: there is no service of this name, or a nested message is not
                known.
        """
        if (cached := self._services.get(name)) is not None:
            return cached
        split_name(name, "srv")
        if self._shared is not None and name not in self._added:
            return self._shared.service(name)
        if (text := self._service_text(name)) is None:
            raise self._unknown_type_error(name)
        with self._lock:
            if (cached := self._services.get(name)) is None:
                for definition in (*parse_service(name, text), event_definition(name)):
                    self._definitions[definition.name] = definition
                cached = self._services[name] = ServiceType(name, self)
        return cached

    def add(self, name: str, text: str) -> None:
        """Add a message (``pkg/msg/Name``) or service (``pkg/srv/Name``) by the text of its file.

        A known type may be added again with the same fields.

        Raises:
            ConfigurationError: the text defines no message or service, or another type has the
                name.
        """
        _, category, _ = split_name(name)
        parse = parse_service if category == "srv" else parse_message
        parsed = parse(name, text)
        with self._lock:
            if name in self.names():
                if category == "srv":
                    known: Any = parse(name, self._service_text(name) or "")
                else:
                    known = self.definition(name)
                if without_defaults(known) != without_defaults(parsed):
                    raise ConfigurationError(
                        f"{name}: {self.distribution} has it with other fields, expected the same"
                    )
                return
            self._added[name] = text

    def definition(self, name: str) -> Definition:
        """Return the fields of a message.

        Raises:
            ConfigurationError: the message is not known.
        """
        cached = self._definitions.get(name)
        if cached is None:
            if name in self._added:
                cached = parse_message(name, self._added[name])
            elif self._shared is not None:
                return self._shared.definition(name)
            elif name in self._stored:
                cached = read_stored(name, self._stored[name])
            elif name in MESSAGES:
                cached = parse_message(name, MESSAGES[name])
            else:
                raise self._unknown_type_error(name)
            self._definitions[name] = cached
        return cached

    def message_of(self, name: str, outer_names: tuple[str, ...] = ()) -> MessageType:
        """Return a message's type; like the methods below, it is for this package only."""
        if (cached := self._messages.get(name)) is not None:
            return cached
        if self._shared is not None and name not in self._added and name not in self._definitions:
            return self._shared.message_of(name)
        if name in outer_names:
            raise ConfigurationError(
                f"{name} has itself within: {' > '.join((*outer_names, name))}"
            )
        with self._lock:
            if (cached := self._messages.get(name)) is None:
                definition = self.definition(name)
                nested_names = sorted(definition.nested_names())
                nested = {
                    need: self.message_of(need, (*outer_names, name)) for need in nested_names
                }
                cached = self._messages[name] = MessageType(definition, nested, self)
        return cached

    def _service_text(self, name: str) -> str | None:
        if name in self._added:
            return self._added[name]
        return None if name in MISSING_BUILT_INS.get(self.distribution, ()) else SERVICES.get(name)

    def source(self, name: str) -> tuple[str, str]:
        """Return the encoding and the text of a type's file.

        A part of a service has no file: its encoding is ``implicit``.

        Raises:
            ConfigurationError: the type is not known.
        """
        if "/srv/" in name:
            text = self._service_text(name)
            return ("implicit", "") if text is None else ("srv", text)
        text = self._added.get(name) or MESSAGES.get(name)
        return "msg", text or self.definition(name).text(defaults=True)

    def hash_of(self, definition: Definition) -> str:
        """Return a type's hash."""
        if self.distribution in WITHOUT_HASHES:
            return NOT_SUPPORTED
        return hash_of_description(describe_with_nested(definition, self.definition))

    def _unknown_type_error(self, name: str) -> ConfigurationError:
        suggestion = did_you_mean(name, self.names())
        return ConfigurationError(
            f"{name}: no such type in {self.distribution}, expected the name of one of its types, "
            f"or add() first{suggestion}"
        )


class _Shared(RosTypes):
    """The types of a distribution itself, without added types."""


@functools.cache
def _shared(distribution: str) -> _Shared:
    return _Shared(distribution)
