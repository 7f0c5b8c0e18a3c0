"""Provide an example of each message, and list the messages that every client needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.models import Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.protocols import Dialect

MESSAGES: tuple[type[m.Message], ...] = tuple(
    kind
    for name in m.__all__
    for kind in [getattr(m, name)]
    if isinstance(kind, type)
    and issubclass(kind, (m.Request, m.Report))
    and kind not in {m.Request, m.Report, m.Acknowledgement}
)
"""Every message that a dialect may have."""

REQUESTS: tuple[type[m.Request], ...] = tuple(
    kind for kind in MESSAGES if issubclass(kind, m.Request)
)
"""The types of all messages that a client sends."""

REQUIRED_MESSAGES: tuple[type[m.Message], ...] = (
    m.Connect,
    m.ConnectAnswer,
    m.Disconnect,
    m.Query,
    m.QueryAnswer,
    m.StatusReport,
    m.ResultContainer,
)
"""Messages that every client needs: a session, a sign of life, the status, results."""

MESSAGES_BY_CAPABILITY: Mapping[str, tuple[type[m.Message], ...]] = {
    "switch": (m.SwitchApplication, m.SwitchAnswer),
    "load_file": (m.LoadFile, m.SwitchAnswer),
    "start_stop": (m.Start, m.Stop),
    "reboot": (m.Reboot,),
    "get_clock": (m.GetClock, m.ClockAnswer),
    "set_clock": (m.SetClock,),
    "input_data": (m.SetInput,),
    "sequence_number": (m.SetSequenceNumber,),
    "get_status": (m.GetStatus,),
    "reset_errors": (m.ResetErrors, m.ResetErrorsAnswer),
    "read_image": (m.ReadImage, m.Image),
}
"""The messages that each field of :class:`~smartcam.Capabilities` depends on."""

_EXAMPLE_VALUES: Mapping[str, Any] = {
    "status": Status.RUNNING,
    "data": b"1.job",
    "name": b"1.job",
    "year": 2024,
    "month": 2,
    "day": 29,
    "hour": 23,
    "minute": 59,
    "second": 30,
}


def make_example(kind: type[m.Message], dialect: Dialect) -> m.Message:
    """Return a message of the given type, with values that fit any dialect."""
    values = {name: _EXAMPLE_VALUES.get(name, 1) for name, _ in m.wire_fields(kind)}
    if "application" in values:
        values["application"] = dialect.application_ids[0]
    return kind(**values)
