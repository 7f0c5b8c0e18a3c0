"""Every error that smartcam raises.

::

    SmartCamError
    ├── ConfigurationError (ValueError)        a value of the user cannot work
    │   ├── LayoutError                        a layout text, with the position of the mistake
    │   ├── PluginError                        a plug-in: unknown, twice there, failed to load
    │   └── MissingExtraError                  an optional part is not installed
    ├── LinkError (ConnectionError)            host, port
    │   ├── ConnectFailedError                 no session; the attempts and outcomes
    │   ├── ConnectionLostError                the session ended by itself
    │   ├── ConnectionTakenError               another client took the camera
    │   └── ConnectionClosedError              closed by us
    ├── ResponseTimeoutError (TimeoutError)    a wait in a session ran out
    ├── CommandRejectedError                   the camera refused; the active application
    ├── UnsupportedError                       this dialect or device cannot do it
    ├── NotAllowedError (PermissionError)      the role of this program's certificate forbids it
    ├── ReservationLostError               others may have used the camera during a reservation
    ├── CameraFaultError                       the camera reports System Error
    ├── CalibrationError (ValueError)          samples that give no calibration: a code says why
    ├── FrameSourceError (OSError)             a source of pictures: gone, in use, stuck
    │   ├── FrameFeatureError                  no such feature, or not settable so now
    │   ├── FrameFormatError                   no such pixels, or bytes that are no picture
    │   └── FrameTimeoutError (TimeoutError)   no picture in time
    ├── InspectionError                        a tool failed: the picture has no verdict
    ├── OutletError                            the far end of an outlet is away; it is tried again
    │   └── EntryRefusedError                  it will never take one of the entries
    ├── RecordingError (OSError)               a recording that could not be written, or read
    ├── RosError                               something between ROS nodes did not work
    │   ├── RosMessageError                    bytes or fields that are no message of their type
    │   └── ServiceCallError                   a call without a reply: no such service, refused
    │       └── ServiceTimeoutError (TimeoutError)
    ├── SubscriberOverflowError                a stream's reader was too slow
    ├── TriggerError                           a trigger that gave no result, and why
    │   ├── OvertriggeredError
    │   ├── NotRunningError
    │   ├── CameraBusyError
    │   ├── InputContainerError
    │   ├── FrameLostError                     a triggered picture that was lost on its way
    │   └── TriggerTimeoutError (TimeoutError)
    ├── ProtocolError
    │   ├── LocalProtocolError                 the protocol's state forbids the request
    │   └── RemoteProtocolError                the peer broke the protocol
    │       ├── FrameError                     magic, length: no frame can be cut
    │       └── MessageError                   a frame whose body does not fit its message
    └── InterpretationError (ValueError)       field, offset, expected, got; the link stays up
        └── WrongApplicationError              the result is another application's: both ids

All errors can be pickled. Texts name the attempt, the received and the expected value; they have at
most 64 bytes of a peer's data.
"""

from __future__ import annotations

__all__ = [
    "CalibrationError",
    "CameraBusyError",
    "CameraFaultError",
    "CommandRejectedError",
    "ConfigurationError",
    "ConnectFailedError",
    "ConnectionClosedError",
    "ConnectionLostError",
    "ConnectionTakenError",
    "EntryRefusedError",
    "FrameError",
    "FrameFeatureError",
    "FrameFormatError",
    "FrameLostError",
    "FrameSourceError",
    "FrameTimeoutError",
    "InputContainerError",
    "InspectionError",
    "InterpretationError",
    "LayoutError",
    "LinkError",
    "LocalProtocolError",
    "MessageError",
    "MissingExtraError",
    "NotAllowedError",
    "NotRunningError",
    "OutletError",
    "OvertriggeredError",
    "PluginError",
    "ProtocolError",
    "RecordingError",
    "RemoteProtocolError",
    "ReservationLostError",
    "ResponseTimeoutError",
    "RosError",
    "RosMessageError",
    "ServiceCallError",
    "ServiceTimeoutError",
    "SmartCamError",
    "SubscriberOverflowError",
    "TriggerError",
    "TriggerTimeoutError",
    "UnsupportedError",
    "WrongApplicationError",
]

MAX_EXCERPT_BYTES = 64
"""Largest number of bytes of a peer's data that an error text or a log line shows."""


MAX_TEXT_CHARACTERS = 10_000
"""Largest number of characters of an error's text: a safety net, since texts already cut the
values that they quote."""

_LEFT_OUT = " ... "


def hex_excerpt(data: bytes | bytearray | memoryview) -> str:
    """Return ``data`` as hex, cut after 64 bytes."""
    shown = bytes(data[:MAX_EXCERPT_BYTES]).hex(" ")
    return f"{shown} ... ({len(data)} bytes)" if len(data) > MAX_EXCERPT_BYTES else shown


def _cut(text: object) -> object:
    if not isinstance(text, str) or str.__len__(text) <= MAX_TEXT_CHARACTERS:
        return text
    half = MAX_TEXT_CHARACTERS // 2 - len(_LEFT_OUT) // 2 - 1
    plain = str.__str__(text)
    return f"{plain[:half]}{_LEFT_OUT}{plain[-half:]}"


class SmartCamError(Exception):
    """Root of all errors of this library.

    Attributes of the subclasses are keyword arguments with defaults, so that ``pickle``
    can rebuild them from the text and then restore the attributes.

    A text has :data:`MAX_TEXT_CHARACTERS` characters at most; longer ones are cut in the middle.
    """

    def __init__(self, *args: object) -> None:
        super().__init__(*map(_cut, args))


class ConfigurationError(SmartCamError, ValueError):
    """A value from the user (an address, an option, a scenario) that cannot work."""


class LayoutError(ConfigurationError):
    """A layout text is wrong.

    Attributes:
        text: the layout text as given.
        position: index of the character where the mistake is.
    """

    def __init__(self, message: str, *, text: str = "", position: int = 0) -> None:
        super().__init__(message)
        self.text = text
        self.position = position


class PluginError(ConfigurationError):
    """A plug-in is unknown, provided twice, or failed to load.

    Attributes:
        name: the name that was asked for.
    """

    def __init__(self, message: str, *, name: str = "") -> None:
        super().__init__(message)
        self.name = name


class MissingExtraError(ConfigurationError):
    """A part of smartcam needs an extra that is not installed.

    Attributes:
        extra: name of the extra, as in ``pip install "smartcam[extra]"``.
    """

    def __init__(self, message: str, *, extra: str = "") -> None:
        super().__init__(message)
        self.extra = extra


class LinkError(SmartCamError, ConnectionError):
    """The link to the camera could not be made, or is lost.

    Attributes:
        host: address of the camera.
        port: port of the camera.
    """

    def __init__(self, message: str, *, host: str = "", port: int = 0) -> None:
        super().__init__(message)
        self.host = host
        self.port = port


class ConnectFailedError(LinkError):
    """No session could be made.

    Attributes:
        attempts: one text for each attempt: what was tried and how it failed.
    """

    def __init__(
        self, message: str, *, host: str = "", port: int = 0, attempts: tuple[str, ...] = ()
    ) -> None:
        super().__init__(message, host=host, port=port)
        self.attempts = attempts


class ConnectionLostError(LinkError):
    """The session ended by itself; ``__cause__`` is the first reason."""


class ConnectionClosedError(LinkError):
    """This program closed the session, or never opened it."""


class ConnectionTakenError(LinkError):
    """Another client took the camera; it serves one, and the newcomer wins."""


class ResponseTimeoutError(SmartCamError, TimeoutError):
    """A wait in a session ran out.

    Attributes:
        message_id: id of the request without an answer, None when a status was waited for.
        waited: seconds.
    """

    def __init__(self, message: str, *, message_id: int | None = None, waited: float = 0.0) -> None:
        super().__init__(message)
        self.message_id = message_id
        self.waited = waited


class CommandRejectedError(SmartCamError):
    """The camera refused a command.

    Attributes:
        message_id: id of the request.
        code: the camera's status or result code.
        active_application: id of the application that is active now.
    """

    def __init__(
        self,
        message: str,
        *,
        message_id: int = 0,
        code: int = 0,
        active_application: int | None = None,
    ) -> None:
        super().__init__(message)
        self.message_id = message_id
        self.code = code
        self.active_application = active_application


class UnsupportedError(SmartCamError):
    """The dialect or the device does not support the request."""


class NotAllowedError(SmartCamError, PermissionError):
    """The role of this program's certificate forbids it; nothing was sent.

    Attributes:
        role: role that the certificate gives, such as ``viewer``.
        certificate: name in the certificate, such as ``dashboard``.
    """

    def __init__(self, message: str, *, role: str = "", certificate: str = "") -> None:
        super().__init__(message)
        self.role = role
        self.certificate = certificate


class ReservationLostError(SmartCamError):
    """A reservation ended, or may have ended, before the end of its block.

    Others may have used the camera.

    A command that raises this error was not carried out.
    """


class CameraFaultError(SmartCamError):
    """The camera reports System Error."""


class CalibrationError(SmartCamError, ValueError):
    """Samples, or a calibration, from which no meaningful number can be computed.

    Attributes:
        code: kind of the mistake, in one word: ``TOO_FEW``, ``COLLINEAR``, ``MIRRORED``, ...
        expected: the expected value, or a text.
        got: the actual value.
    """

    def __init__(
        self, message: str, *, code: str = "", expected: object = None, got: object = None
    ) -> None:
        super().__init__(message)
        self.code = code
        self.expected = expected
        self.got = got


class FrameSourceError(SmartCamError, OSError):
    """A source of pictures cannot be opened, is in use, is stuck, or is gone.

    Attributes:
        source: name of the source.
        available: names of the formats, devices or controls that the source has instead.
    """

    def __init__(self, message: str, *, source: str = "", available: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.source = source
        self.available = available


class FrameFormatError(FrameSourceError):
    """A source has no such pixels, or bytes are no picture of their format."""


class FrameFeatureError(FrameSourceError):
    """A device has no such feature, or it cannot be read or set now, or not to that value."""


class FrameTimeoutError(FrameSourceError, TimeoutError):
    """No picture came in time."""


class InspectionError(SmartCamError):
    """A tool of a program failed, so that the picture has no verdict.

    Attributes:
        application: number of the application.
        tool: name of the tool in its program.
    """

    def __init__(self, message: str, *, application: int | None = None, tool: str = "") -> None:
        super().__init__(message)
        self.application = application
        self.tool = tool


class OutletError(SmartCamError):
    """The far end of an outlet did not take entries; they are tried again."""


class EntryRefusedError(OutletError):
    """The far end of an outlet will never take one of the entries.

    Attributes:
        index: index of the entry among the entries to deliver; the entries before it were taken.
    """

    def __init__(self, message: str = "", *, index: int = 0) -> None:
        super().__init__(message)
        self.index = index


class RecordingError(SmartCamError, OSError):
    """A recording could not be written, or could not be read.

    A full or slow disk ends a recording; the part written before stays and can be read. A file that
    would unpack to more than any recording is not read.
    """


class RosError(SmartCamError):
    """Something between ROS nodes did not work."""


class RosMessageError(RosError):
    """Bytes, or fields, that are no message of the type that they should have."""


class ServiceCallError(RosError):
    """A call of a ROS service had no reply: no node serves it, or the node refused or failed.

    Attributes:
        service: name of the service.
    """

    def __init__(self, message: str, *, service: str = "") -> None:
        super().__init__(message)
        self.service = service


class ServiceTimeoutError(ServiceCallError, TimeoutError):
    """No reply came in time; whether the call was carried out is unknown."""


class SubscriberOverflowError(SmartCamError):
    """A stream with ``overflow="error"`` was full; items after the queued ones are lost."""


class TriggerError(SmartCamError):
    """A trigger that gave no result."""


class OvertriggeredError(TriggerError):
    """The camera dropped a trigger, perhaps another client's: the camera does not name it."""


class NotRunningError(TriggerError):
    """The application is stopped, so the camera takes no trigger."""


class CameraBusyError(TriggerError):
    """The camera does not wait for a trigger, and waiting was not wanted."""


class InputContainerError(TriggerError):
    """The numbers of input containers and of inspections differ (Input Container bit)."""


class FrameLostError(TriggerError):
    """The picture that a trigger caused, or may have caused, was lost on its way here."""


class TriggerTimeoutError(TriggerError, TimeoutError):
    """No result came in time.

    Attributes:
        waited: seconds.
    """

    def __init__(self, message: str, *, waited: float = 0.0) -> None:
        super().__init__(message)
        self.waited = waited


class ProtocolError(SmartCamError):
    """The protocol was broken, by one side or the other."""


class LocalProtocolError(ProtocolError):
    """The protocol's state forbids a request of this program; nothing was sent."""


class RemoteProtocolError(ProtocolError):
    """The peer broke the protocol.

    Attributes:
        offset: byte where the mistake is, counted from the start of the frame.
        data: first bytes of the frame, at most 64.
    """

    def __init__(
        self, message: str, *, offset: int = 0, data: bytes | bytearray | memoryview = b""
    ) -> None:
        super().__init__(message)
        self.offset = offset
        self.data: bytes = bytes(data[:MAX_EXCERPT_BYTES])


class FrameError(RemoteProtocolError):
    """No frame can be cut from these bytes: wrong magic or impossible length."""


class MessageError(RemoteProtocolError):
    """A whole frame whose body does not fit its message, or comes at the wrong time."""


class InterpretationError(SmartCamError, ValueError):
    """A result container does not fit its layout; the link stays up.

    Attributes:
        field: name of the field, or "" if the whole container is meant.
        offset: byte offset in the container's data.
        expected: the expected value there.
        got: the actual value.
    """

    def __init__(
        self,
        message: str,
        *,
        field: str = "",
        offset: int = 0,
        expected: object = None,
        got: object = None,
    ) -> None:
        super().__init__(message)
        self.field = field
        self.offset = offset
        self.expected = expected
        self.got = got


class WrongApplicationError(InterpretationError):
    """A result came from another application than expected.

    ``expected`` and ``got`` are the two application ids.
    """
