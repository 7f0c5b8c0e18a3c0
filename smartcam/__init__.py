"""Talk to industrial smart cameras.

``async with smartcam.connect("bvs://192.168.0.10", application=7) as camera`` gives a
:class:`~smartcam.Camera`. ``import smartcam`` is light: names are resolved when they
are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam import emulator, exceptions, frames, interpreters, layout, models, protocols
    from smartcam.backoff import Backoff
    from smartcam.camera import Camera
    from smartcam.client import SmartCamera
    from smartcam.connecting import connect
    from smartcam.doctor import find
    from smartcam.exceptions import (
        CalibrationError,
        CameraBusyError,
        CameraFaultError,
        CommandRejectedError,
        ConfigurationError,
        ConnectFailedError,
        ConnectionClosedError,
        ConnectionLostError,
        ConnectionTakenError,
        EntryRefusedError,
        FrameError,
        FrameFeatureError,
        FrameFormatError,
        FrameLostError,
        FrameSourceError,
        FrameTimeoutError,
        InputContainerError,
        InspectionError,
        InterpretationError,
        LayoutError,
        LinkError,
        LocalProtocolError,
        MessageError,
        MissingExtraError,
        NotAllowedError,
        NotRunningError,
        OutletError,
        OvertriggeredError,
        PluginError,
        ProtocolError,
        RecordingError,
        RemoteProtocolError,
        ReservationLostError,
        ResponseTimeoutError,
        RosError,
        RosMessageError,
        ServiceCallError,
        ServiceTimeoutError,
        SmartCamError,
        SubscriberOverflowError,
        TriggerError,
        TriggerTimeoutError,
        UnsupportedError,
        WrongApplicationError,
    )
    from smartcam.layout import Layout
    from smartcam.models import (
        ApplicationChanged,
        CameraEvent,
        Capabilities,
        Connected,
        Disconnected,
        Header,
        Localization,
        NoticeReceived,
        Pose,
        Position,
        Quaternion,
        Reconnected,
        Result,
        Statistics,
        Status,
        StatusChanged,
    )
    from smartcam.observers import Observer

__version__ = "0.1.0"

__all__ = [
    "ApplicationChanged",
    "Backoff",
    "CalibrationError",
    "Camera",
    "CameraBusyError",
    "CameraEvent",
    "CameraFaultError",
    "Capabilities",
    "CommandRejectedError",
    "ConfigurationError",
    "ConnectFailedError",
    "Connected",
    "ConnectionClosedError",
    "ConnectionLostError",
    "ConnectionTakenError",
    "Disconnected",
    "EntryRefusedError",
    "FrameError",
    "FrameFeatureError",
    "FrameFormatError",
    "FrameLostError",
    "FrameSourceError",
    "FrameTimeoutError",
    "Header",
    "InputContainerError",
    "InspectionError",
    "InterpretationError",
    "Layout",
    "LayoutError",
    "LinkError",
    "LocalProtocolError",
    "Localization",
    "MessageError",
    "MissingExtraError",
    "NotAllowedError",
    "NotRunningError",
    "NoticeReceived",
    "Observer",
    "OutletError",
    "OvertriggeredError",
    "PluginError",
    "Pose",
    "Position",
    "ProtocolError",
    "Quaternion",
    "Reconnected",
    "RecordingError",
    "RemoteProtocolError",
    "ReservationLostError",
    "ResponseTimeoutError",
    "Result",
    "RosError",
    "RosMessageError",
    "ServiceCallError",
    "ServiceTimeoutError",
    "SmartCamError",
    "SmartCamera",
    "Statistics",
    "Status",
    "StatusChanged",
    "SubscriberOverflowError",
    "TriggerError",
    "TriggerTimeoutError",
    "UnsupportedError",
    "WrongApplicationError",
    "__version__",
    "connect",
    "emulator",
    "exceptions",
    "find",
    "frames",
    "interpreters",
    "layout",
    "models",
    "protocols",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "": "emulator exceptions frames interpreters layout models protocols",
            "backoff": "Backoff",
            "camera": "Camera",
            "client": "SmartCamera",
            "connecting": "connect",
            "doctor": "find",
            "exceptions": " ".join(name for name in __all__ if name.endswith("Error")),
            "layout": "Layout",
            "models": "ApplicationChanged CameraEvent Capabilities Connected Disconnected Header "
            "Localization NoticeReceived Pose Position Quaternion Reconnected Result "
            "Statistics Status StatusChanged",
            "observers": "Observer",
        },
    )
