"""What the device says, in short words that tests can compare."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.models import Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from smartcam.emulator import Device

SHORT = {
    Status.OVERHEAT: "hot",
    Status.SYSTEM_ERROR: "error",
    Status.INPUT_CONTAINER: "input",
    Status.BUSY: "busy",
    Status.RUNNING: "run",
    Status.OVERTRIGGERED: "over",
    Status.WAITING_FOR_TRIGGER: "wait",
}


def word(status: Status) -> str:
    """Return a status as ``[run wait]``."""
    return f"[{' '.join(name for bit, name in SHORT.items() if bit & status)}]"


def heard(device: Device) -> list[str]:
    """Take what the device said, one word a message."""
    return [_short(message) for message in device.take_output()]


def _short(message: m.Message) -> str:
    match message:
        case m.ConnectAnswer(version=version):
            return f"hello {version}"
        case m.StatusReport(status=status, endian=0):
            return word(status)
        case m.StatusReport(status=status, endian=endian):
            return f"{word(status)} endian {endian}"
        case m.ResultContainer(application=application, data=data):
            return f"result {application} {data.hex()}"
        case m.QueryAnswer(application=application):
            return f"active {application}"
        case m.SwitchAnswer(code=code, application=application):
            return f"switched {code} {application}"
        case m.ClockAnswer():
            return (
                f"{message.year}-{message.month}-{message.day} "
                f"{message.hour}:{message.minute}:{message.second}"
            )
        case _:
            raise AssertionError(f"a camera does not say {message}")
