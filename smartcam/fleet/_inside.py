"""Names for other packages of smartcam; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.fleet._agent.outlet_service import ReportedOutlet, ReportedStore
    from smartcam.fleet._agent.reload import FleetChanges
    from smartcam.fleet._agent.summary import CameraSummary
    from smartcam.fleet._bus.address import FleetAddress
    from smartcam.fleet._bus.bus import Bus
    from smartcam.fleet._bus.keys import Keys, patterns_overlap
    from smartcam.fleet._bus.zenoh import ZenohConnection
    from smartcam.fleet._file.fleet_file import fleet_schema
    from smartcam.fleet._file.operations import OperationsSection
    from smartcam.fleet._file.recording import RecordSection
    from smartcam.fleet._file.ros import RosSection
    from smartcam.fleet._opening import fleet_camera
    from smartcam.fleet._operations.metric_families import exposition, require_prometheus
    from smartcam.fleet._operations.metrics import read_counts
    from smartcam.fleet._outlets import FleetOutlets
    from smartcam.fleet._program.fleet import FleetResults
    from smartcam.fleet._ros import RosFleet, ros_of
    from smartcam.fleet._security.authority import MadeCertificate, make_certificates
    from smartcam.fleet._security.certificates import (
        expiry_warning,
        may_command,
        read_identity,
        shake_hands,
    )
    from smartcam.fleet._security.door import raise_descriptor_limit

__all__ = [
    "Bus",
    "CameraSummary",
    "FleetAddress",
    "FleetChanges",
    "FleetOutlets",
    "FleetResults",
    "Keys",
    "MadeCertificate",
    "OperationsSection",
    "RecordSection",
    "ReportedOutlet",
    "ReportedStore",
    "RosFleet",
    "RosSection",
    "ZenohConnection",
    "expiry_warning",
    "exposition",
    "fleet_camera",
    "fleet_schema",
    "make_certificates",
    "may_command",
    "patterns_overlap",
    "raise_descriptor_limit",
    "read_counts",
    "read_identity",
    "require_prometheus",
    "ros_of",
    "shake_hands",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_file.fleet_file": "fleet_schema",
            "_agent.outlet_service": "ReportedStore ReportedOutlet",
            "_program.fleet": "FleetResults",
            "_agent.reload": "FleetChanges",
            "_agent.summary": "CameraSummary",
            "_bus.address": "FleetAddress",
            "_bus.bus": "Bus",
            "_bus.keys": "Keys patterns_overlap",
            "_bus.zenoh": "ZenohConnection",
            "_file.operations": "OperationsSection",
            "_file.recording": "RecordSection",
            "_file.ros": "RosSection",
            "_opening": "fleet_camera",
            "_operations.metric_families": "exposition require_prometheus",
            "_operations.metrics": "read_counts",
            "_outlets": "FleetOutlets",
            "_ros": "RosFleet ros_of",
            "_security.authority": "MadeCertificate make_certificates",
            "_security.certificates": "expiry_warning may_command read_identity shake_hands",
            "_security.door": "raise_descriptor_limit",
        },
    )
