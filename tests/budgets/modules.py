"""Parsers of the table by the modules that read bytes or text."""

from __future__ import annotations

import re

from tests import ROOT

READS = re.compile(
    r"json\.loads|yaml_module|[^_]compose\(text|load_yaml|load_json|expat|zipfile|literal_eval"
    r"|XMLParser|\.unpack(?:_from)?\(|iter_unpack|from_bytes\(|fromhex\(|b64decode|frombuffer|unhexlify"
    r"|decode_jpeg|\.recv\("
)
"""The pattern by which a module that reads bytes or text is known."""

PARSERS_OF: dict[str, str] = {
    "calibration._files.store": "calibrations",
    "calibration.formats._cameras": "cameras: camera_info",
    "calibration.formats._foreign": "cameras: multical",
    "calibration.formats._handeye": "transforms: easy_handeye",
    "calibration.formats._opencv": "transforms: opencv",
    "calibration.formats._plain": "samples: moveit",
    "calibration.formats._ros": "transforms: tf",
    "calibration.formats._samples": "samples: moveit",
    "calibration.formats._xml": "transforms: urdf",
    "depth._pcd": "PCD",
    "depth._ply": "PLY",
    "depth._tables": "PLY",
    "fleet._agent.bundle": "fleet: bundles",
    "fleet._agent.claims": "fleet: requests in JSON",
    "fleet._frames.wire": "fleet: messages",
    "fleet._json.json_services": "fleet: requests in JSON",
    "fleet._program.reading": "fleet: results",
    "fleet._agent.outlet_service": "fleet: requests in JSON",
    "fleet._agent.reload_service": "fleet: requests in JSON",
    "fleet._json.services": "fleet: messages",
    "fleet._agent.summary": "fleet: summaries",
    "fleet._bus.wire": "fleet: messages",
    "frames._codecs.bitmap": "bitmaps",
    "frames._gige.assembler": "GigE: packets of a stream",
    "frames._gige.control": "GigE: answers",
    "frames._gige.description": "GenICam: descriptions",
    "frames._gige.event_channel": "GigE: events",
    "frames._gige.features": "GenICam: values",
    "frames._gige.gvcp": "GigE: answers",
    "frames._gige.messages": "GigE: chunk data",
    "frames._gige.gvsp": "GigE: packets of a stream",
    "frames._codecs.jpeg": "JPEG",
    "frames._pixels.layouts": "JPEG",
    "frames._codecs.pictures": "JPEG",
    "frames._streaming.rtp.assembling": "RTP and H.264",
    "frames._streaming.rtp.packets": "RTCP",
    "frames._streaming.rtp.jpeg": "RTP and JPEG",
    "frames._streaming.rtsp_client.answers": "RTSP: answers",
    "frames._streaming.rtsp_client.description": "RTSP: answers",
    "frames._video.multipart": "web cameras: pictures",
    "frames._streaming.rtsp.authentication": "RTSP: requests",
    "frames._streaming.rtsp.messages": "RTSP: requests",
    "frames._video.redirects": "redirects of a server",
    "interpreters._base": "containers: raw",
    "interpreters._basic": "containers: strings50",
    "layout": "containers: table",
    "layout._codec": "containers: record",
    "layout._files": "layouts as YAML",
    "layout._tables": "containers: table",
    "layout._yaml_files": "scenarios",
    "layout._yaml_parsing": "YAML",
    "outlets._mqtt": "MQTT: commands",
    "protocols._bvs": "frames of a camera, handbook",
    "protocols._framed.dialect": "frames of a camera, handbook",
    "makes._ifm.chunks": "ifm: images",
    "makes._ifm.layouts": "ifm: layouts of a client",
    "makes._ifm.camera": "ifm: layouts of a client",
    "protocols._insight.answers": "In-Sight: images",
    "recording._bags.specs": "recordings",
    "recording._folders.replay": "recordings",
    "recording._folder": "recordings",
    "recording._mcap.form": "recordings",
    "recording._pcap": "recordings",
    "recording._mcap.records": "recordings",
    "recording._pictures.protobuf": "recordings",
    "recording._replays.lines": "recordings",
    "recording._replays.schedule": "recordings",
    "ros1._json_messages": "rosbridge: operations",
    "ros1._link": "rosbridge: operations",
    "ros1._retiring": "rosbridge: operations",
    "ros2._types.codec": "ROS: messages",
    "ros2._types.definitions": "ROS: definitions of messages",
    "web._routes": "pages: bodies of calls",
    "_client.link": "frames of a camera, handbook",
    "_cli.byte_text": "hex dumps of frames",
}
"""By module (without ``smartcam.``): the row of the table in which it is measured."""

OTHERS: dict[str, str] = {
    "_cli": "options and files of the one who calls it",
    "calibration.wizards": "journals and lists that we wrote, bounded by a line",
    "conformance": "a judge reads what its user runs",
    "depth._colours": "our own tables",
    "doctor": "fields of a result that an interpreter has read",
    "emulator": "our own log, and options of a scenario",
    "fleet._security.door": "addresses of the kernel's connections",
    "fleet._bus.errors": "fields of a message that was read",
    "fleet._outlets": "answers of agents, which are read before",
    "frames._gige.force_address": "an address of the one who calls it",
    "frames._v4l2": "structures of the kernel",
    "frames._video.frames": "pictures that FFmpeg has decoded",
    "inspection._picture": "files that OpenCV decodes",
    "outlets._opcua.system": "entries that this program wrote, and groups of its files",
    "outlets._spool": "entries that this program wrote",
    "outlets._store": "entries that this program wrote",
    "inspection._teaching": "files that the reader of YAML has read before",
    "recording._bags.items": "our own messages become a bag",
    "recording._folders.recorder": "results that were read",
    "recording._packets": "packets that we write, for their checksums",
    "ros2._node.attachment": "33 bytes",
    "testing.proxy": "bytes that pass as they came",
    "ros2._cameras.image_messages": "our own pictures become messages",
    "ros2._types.values": "values of the program itself",
}
"""By module or package: why it is in no row."""


def reading_modules() -> list[str]:
    """Return the modules that read bytes or text, without ``smartcam.``."""
    package = ROOT / "smartcam"
    found = []
    for path in package.rglob("*.py"):
        if READS.search(path.read_text(encoding="utf-8")):
            parts = path.relative_to(package).with_suffix("").parts
            found.append(".".join(part for part in parts if part != "__init__"))
    return sorted(found)


def without_place(module: str) -> bool:
    """Return whether a module is in none of the tables."""
    packages = [module.rsplit(".", count)[0] for count in range(module.count(".") + 1)]
    return module not in PARSERS_OF and not any(one in OTHERS for one in packages)
