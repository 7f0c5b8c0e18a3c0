"""Checks of a protocol and its dialects: their descriptions are consistent."""
# ruff: noqa: S101 - they are tests, in a package so that others can run them

from __future__ import annotations

import contextlib
import json
import re
from typing import TYPE_CHECKING, Any

import pytest

from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    LocalProtocolError,
    PluginError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.models import jsonable
from smartcam.protocols import CodeMeaning, Frame, FramedDialect, RawRequest, Transport, Verdict
from smartcam.protocols import messages as m
from smartcam.protocols._inside import Framer, ReadableFrame
from smartcam.registry import PROTOCOLS
from smartcam.settings import Address, parse_address
from smartcam.testing._suites.protocols.parameters import SuiteBase
from smartcam.testing._suites.protocols.words import (
    MESSAGES,
    MESSAGES_BY_CAPABILITY,
    REQUESTS,
    REQUIRED_MESSAGES,
    make_example,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from hypothesis.strategies import DataObject

    from smartcam.protocols import Dialect

SCHEME = re.compile(r"[a-z][a-z0-9+.-]*")
"""The beginning of a URL (RFC 3986, 3.1), in lower case."""

CODES = (*range(-300, 301), -(1 << 31), (1 << 16) - 1, (1 << 32) - 1)
"""Result codes whose meanings are checked."""


def _is_printable_line(text: object) -> bool:
    return isinstance(text, str) and bool(text.strip()) and text.isprintable()


class DialectChecks(SuiteBase):
    """The checks of every protocol and dialect, without a camera."""

    # ------------------------------------------------------------------ the protocol

    def test_protocol_describes_itself(self) -> None:
        """Check that a URL can name schemes, port, models and dialects."""
        protocol = self.protocol
        assert _is_printable_line(protocol.name), f"name: expected a line, got {protocol.name!r}"
        assert protocol.schemes, "schemes: expected at least one"
        for scheme, transport in protocol.schemes.items():
            assert SCHEME.fullmatch(scheme), f"scheme {scheme!r}: expected lower case"
            assert isinstance(transport, Transport), f"scheme {scheme!r}: {transport!r}"
        port = protocol.default_port
        assert 0 < port < 1 << 16, f"default_port: expected 1 to 65535, got {port}"
        for model in protocol.models:
            assert model == model.upper(), f"model {model!r}: expected upper case"
        assert protocol.dialects, "dialects: expected at least one"
        for name, dialect in protocol.dialects.items():
            assert dialect.name == name, f"dialects[{name!r}] calls itself {dialect.name!r}"
        for name, about in protocol.parameters.items():
            assert name not in {"dialect", "quirks"}, f"parameter {name!r} is reserved"
            assert _is_printable_line(about), (
                f"parameter {name!r}: expected a line that says what it is"
            )

    def test_entry_point_gives_the_protocol(self) -> None:
        """Check that ``connect()`` finds the protocol: it is installed, and the names agree."""
        name = self.protocol.name
        try:
            loaded = PROTOCOLS.load(name)
        except PluginError as error:
            message = f"{error}. Is the package installed (pip install -e .), and is {name!r} the"
            raise AssertionError(f"{message} name under smartcam.protocols?") from error
        assert loaded is self.protocol, f"the entry point {name!r} gives {loaded!r:.300}"

    def test_every_dialect_is_tried(self) -> None:
        """Check that a client tries each dialect, and only the given one if one is given."""
        protocol = self.protocol
        used_transports = set(protocol.schemes.values())
        surplus = set(protocol.detection) - used_transports
        assert not surplus, f"detection: no scheme has {surplus}"
        for transport in used_transports:
            tries = protocol.dialect_groups(transport)
            tried = {dialect.name for group in tries for dialect in group}
            assert all(tries), f"detection over {transport.value}: a group is empty"
            missing = set(protocol.dialects) - tried
            assert not missing, f"detection over {transport.value} leaves out {missing}"
            unknown = tried - set(protocol.dialects)
            assert not unknown, f"detection over {transport.value}: {unknown} is not a dialect"
            for name in protocol.dialects:
                (group,) = protocol.dialect_groups(transport, name)
                others = {dialect.name for dialect in group} - {name}
                assert not others, f"given {name!r} over {transport.value} tries {others}, too"

    def test_model_picks_the_protocol(self) -> None:
        """Check that a bare host with a model, in any case of letters, is of this protocol."""
        for model in self.protocol.models:
            for written in (model, model.lower()):
                address = parse_address("192.0.2.7", model=written)
                assert address.protocol == self.protocol.name, f"model {written!r} is {address}"
                assert address.port == self.protocol.default_port

    # ------------------------------------------------------------------ a dialect

    def test_dialect_describes_itself(self, dialect: Dialect) -> None:
        """Check a dialect's name, source, and the ids that an application may have."""
        assert _is_printable_line(dialect.about), f"about: expected a line, got {dialect.about!r}"
        assert _is_printable_line(dialect.source), (
            f"source: expected a line, got {dialect.source!r}"
        )
        assert dialect.label.startswith(dialect.name), f"label: {dialect.label!r}"
        abilities = dialect.capabilities
        assert abilities.dialect == dialect.name, f"capabilities.dialect: {abilities.dialect!r}"
        ids = dialect.application_ids
        assert isinstance(ids, range), f"application_ids: expected a range, got {ids!r}"
        assert ids, "application_ids: expected at least one"
        assert ids.step == 1, f"application_ids: expected a step of 1, got {ids!r}"
        assert ids.start >= 0, f"application_ids: expected no negative one, got {ids!r}"
        for name in ("results_are_attributable", "exclusive", "has_login"):
            assert isinstance(getattr(dialect, name), bool), f"{name}: expected a bool"
        if dialect.has_login:
            assert "user" in self.protocol.parameters, "has_login, but no parameter 'user'"

    def test_dialect_has_what_a_client_needs(self, dialect: Dialect) -> None:
        """Check for a session, a sign of life, results, and the status: by itself or on request."""
        missing = [kind.__name__ for kind in REQUIRED_MESSAGES if not dialect.has(kind)]
        assert not missing, f"has() is False for {', '.join(missing)}"
        assert dialect.answers(m.Connect), "Connect must be answered"
        assert dialect.answers(m.Query), "Query must be answered: it is the sign of life"
        abilities = dialect.capabilities
        assert abilities.unasked_status or abilities.get_status, (
            "capabilities: the status neither comes by itself nor can be asked for"
        )

    def test_capabilities_are_those_of_its_messages(self, dialect: Dialect) -> None:
        """Check that each ability has its messages, and the other way round."""
        for name, needed in MESSAGES_BY_CAPABILITY.items():
            has_ability = getattr(dialect.capabilities, name)
            has_messages = [dialect.has(kind) for kind in needed]
            names = " and ".join(kind.__name__ for kind in needed)
            if has_ability:
                assert all(has_messages), (
                    f"capabilities.{name} is True, but has() is False for {names}"
                )
            else:
                assert not has_messages[0], (
                    f"capabilities.{name} is False, but has() is True for {names}"
                )

    def test_messages_have_ids_names_and_fields(self, dialect: Dialect) -> None:
        """Check that each message has an id and a name, and that its fields are the message's."""
        for kind in MESSAGES:
            if not dialect.has(kind):
                continue
            message = make_example(kind, dialect)
            assert isinstance(dialect.message_id(kind), int), f"message_id({kind.__name__})"
            assert dialect.message_id(message) == dialect.message_id(kind), kind.__name__
            label = dialect.message_label(message)
            assert kind.__name__ in label, f"message_label({kind.__name__}) is {label!r}"
            unknown = set(dialect.fields(kind)) - {name for name, _ in m.wire_fields(kind)}
            assert not unknown, f"fields({kind.__name__}) has {unknown}"

    def test_message_unknown_to_the_dialect_is_unsupported(self, dialect: Dialect) -> None:
        """Check that the error for a missing message names the dialect."""
        for kind in MESSAGES:
            if dialect.has(kind):
                continue
            for message in (kind, make_example(kind, dialect)):
                text = _error_text(UnsupportedError, dialect.message_id, message)
                assert text is not None, f"has() is False for {kind.__name__}, but it has an id"
                assert dialect.name in text, f"{text}: expected the name of the dialect in it"

    def test_codes_mean_something(self, dialect: Dialect) -> None:
        """Check that each code has a text and a verdict; codes for success and refusal exist."""
        verdicts: set[Verdict] = set()
        for request in (None, *filter(dialect.has, REQUESTS)):
            for code in CODES:
                meaning = dialect.code(code, request)
                where = f"code({code}, {getattr(request, '__name__', None)})"
                assert isinstance(meaning, CodeMeaning), (
                    f"{where}: expected a CodeMeaning, got {meaning!r}"
                )
                assert _is_printable_line(meaning.text), (
                    f"{where}: expected a text, got {meaning.text!r}"
                )
                assert isinstance(meaning.verdict, Verdict), f"{where}: {meaning.verdict!r}"
                verdicts.add(meaning.verdict)
        assert Verdict.DONE in verdicts, "no code says that a request was done"
        if dialect.capabilities.result_codes:
            assert verdicts - {Verdict.DONE}, "result_codes, but every code says done"

    def test_any_frame_can_be_shown(self, dialect: Dialect) -> None:
        """Check that a trace shows whatever comes, and never fails."""
        from smartcam.testing._suites import strategies

        def check(data: DataObject) -> None:
            payload = data.draw(strategies.noise(()))
            for sender in m.Sender:
                for message_id in (0, 1, 2, 0x12, 0x20, 0x40, 0xFFFF):
                    check_described(dialect, sender, Frame(message_id, payload))

        strategies.run_with_examples(check)

    def test_any_raw_request_is_taken_or_refused(self, dialect: Dialect) -> None:
        """Check that any id, known or not, is a request or one of smartcam's errors."""
        refusals = (
            UnsupportedError,
            LocalProtocolError,
            ConfigurationError,
            CommandRejectedError,
        )
        for message_id in (0, 1, 0x12, 0x7777, -1, "", "nobody's", "é\n\0"):
            with contextlib.suppress(*refusals):
                raw = dialect.raw_request(message_id, b"1")
                assert isinstance(raw, RawRequest), f"raw_request({message_id!r}): {raw!r}"
        other = m.QueryAnswer(application=1)
        with contextlib.suppress(*refusals):
            body = dialect.body(other)
            assert isinstance(body, bytes), f"body({other}): expected bytes, got {body!r}"

    def test_unknown_quirk_is_a_mistake(self, dialect: Dialect) -> None:
        """Check that a dialect with its own quirks is the same, and an unknown quirk an error."""
        same = dialect.with_quirks(dialect.quirks)
        assert same.label == dialect.label, f"with its own quirks it is {same.label!r}"
        assert dialect.with_parameters({}).name == dialect.name
        text = _error_text(ConfigurationError, dialect.with_quirks, ["no such quirk"])
        assert text is not None, "with_quirks(['no such quirk']) did not fail"
        assert "no such quirk" in text, f"{text}: expected the name of the quirk in it"

    def test_address_is_read_back(self, dialect: Dialect) -> None:
        """Check that a URL with all options is read back, and has no password."""
        parameters: list[tuple[tuple[str, str], ...]] = [()]
        parameters += [
            tuple(conversation.parameters.items())
            for conversation in self.conversations
            if conversation.dialect == dialect.name and conversation.parameters
        ]
        for scheme in self.protocol.schemes:
            for host in ("192.0.2.7", "2001:db8::7"):
                for values in parameters:
                    check_address(
                        Address(
                            self.protocol.name,
                            scheme,
                            host,
                            self.protocol.default_port,
                            dialect.name,
                            tuple(sorted(dialect.quirks)),
                            values,
                        )
                    )

    # ------------------------------------------------------------------ binary frames

    def test_framed_messages_are_read_back(self, dialect: Dialect) -> None:
        """Check that a dialect of binary frames reads what it writes, whatever the values are."""
        if not isinstance(dialect, FramedDialect):
            pytest.skip("not a FramedDialect: the conversations of its machine check it")
        from smartcam.testing._suites import strategies

        def check(data: DataObject) -> None:
            row = data.draw(strategies.st.sampled_from(dialect.table))
            values: dict[str, Any] = {}
            for name, wire in row.fields:
                largest = _MAX_VALUES.get((wire, dialect.word))
                drawn = (
                    strategies.st.integers(0, largest)
                    if largest
                    else strategies.st.binary(max_size=64)
                )
                values[name] = data.draw(drawn, label=name)
            check_read_back(dialect, row.type, values)

        for row in dialect.table:
            for choice in (0, 1, -1):
                largest_values = [
                    (name, _MAX_VALUES.get((wire, dialect.word))) for name, wire in row.fields
                ]
                edges = {
                    name: (0, 1, largest)[choice] if largest else b"\0\xff"
                    for name, largest in largest_values
                }
                check_read_back(dialect, row.type, edges)
        strategies.run_with_examples(check)


_MAX_VALUES: Mapping[tuple[m.Wire, str], int] = {
    (m.Wire.WORD, "I"): (1 << 32) - 1,
    (m.Wire.WORD, "H"): (1 << 16) - 1,
    (m.Wire.UINT32, "I"): (1 << 32) - 1,
    (m.Wire.UINT32, "H"): (1 << 32) - 1,
}
"""Largest value of each kind of number, by the format of the dialect's words."""


def _error_text(
    error_type: type[SmartCamError], call: Callable[[Any], object], argument: object
) -> str | None:
    """Return the text of the error that a call raises, None if it raises no error."""
    try:
        call(argument)
    except error_type as exc:
        return str(exc)
    return None


def check_described(dialect: Dialect, sender: m.Sender, frame: Frame) -> ReadableFrame:
    """Check that a frame can be shown, in JSON as well.

    Raises:
        AssertionError: the frame cannot be shown.
    """
    readable = dialect.make_readable(sender, frame)
    expected = f"make_readable({frame}): expected a ReadableFrame, got {readable!r}"
    assert isinstance(readable, ReadableFrame), expected
    assert _is_printable_line(readable.message), f"make_readable({frame}): {readable.message!r}"
    assert isinstance(readable.data, bytes), f"make_readable({frame}): data {readable.data!r}"
    json.dumps(jsonable(readable.fields), allow_nan=False)
    return readable


def check_address(address: Address) -> None:
    """Check that an address equals the one in its own URL.

    Raises:
        AssertionError: the address differs.
    """
    url = address.url
    parsed = parse_address(url)
    assert parsed.url == url, f"{url} is read as {parsed.url}"
    assert parsed[:6] == address[:6], f"{url} is read as {parsed!r}, not as {address!r}"
    secret = dict(address.parameters).get("password")
    assert not secret or secret not in f"{url} {address!r} {parsed!r}", f"{url} has the password"


def check_read_back(
    dialect: FramedDialect, kind: type[m.Message], values: Mapping[str, Any]
) -> None:
    """Check that a message with these values on the wire goes through bytes unchanged.

    Raises:
        AssertionError: the message changes.
    """
    if kind is m.StatusReport:
        values = {**values, "status": dialect.status_bits.read(values["status"])}
    message = kind(**values)
    encoded = dialect.encode(message)
    framer = Framer(dialect.header)
    framer.feed(encoded)
    frame = framer.next_frame()
    assert frame is not None, f"{encoded.hex(' ')} of {message} makes no frame"
    assert framer.buffered == 0, f"{encoded.hex(' ')} of {message}: bytes are left over"
    decoded = dialect.decode(kind.sender, frame)
    assert decoded == message, f"{encoded.hex(' ')} of {message} is read as {decoded}"
