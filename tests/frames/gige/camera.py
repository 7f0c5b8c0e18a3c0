"""A GigE Vision camera on real sockets, with all the faults of a network on request.

It is written from the standard and shares no code with the driver. Each row of a frame begins with
the frame's number, so that a test notices rows of two frames in one picture.
"""

import asyncio
import random
import socket
import struct
import zipfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, cast

import numpy as np

WIDTH, HEIGHT = 0x10000, 0x10004
FORMAT, START, PERIOD, EXPOSURE, FLAGS, PAYLOAD_EXTRA, LOCKED = (
    0x10008, 0x1000C, 0x10010, 0x10014, 0x1001C, 0x10020, 0x10024,
)  # fmt: skip
SELECTOR, TRIGGERS, SOFTWARE, USER_SET, USER_LOAD, USER_SAVE, USER_DEFAULT, BLACK = (
    0x10100, 0x10110, 0x10140, 0x10150, 0x10154, 0x10158, 0x1015C, 0x10160,
)  # fmt: skip
CHUNKS, LINES, EVENT, NOTIFY = 0x10170, 0x10174, 0x10180, 0x10190
EVENTS = {"ExposureEnd": (0, 0x9002), "FrameTriggerMissed": (1, 0x9003), "Plain": (2, 0x9004)}
"""The place of each event in EventSelector, and its number."""
MAC = bytes.fromhex("02 00 00 00 00 01")
XML_ADDRESS = 0x20000

MONO8, MONO16, ODD = 0x01080001, 0x01100007, 0x01080FFF

HEAD = (
    '<RegisterDescription ModelName="T" VendorName="T" StandardNameSpace="GEV" '
    'SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1" '
    'MinorVersion="0" SubMinorVersion="0" ProductGuid="00000000-0000-0000-0000-000000000001" '
    'VersionGuid="00000000-0000-0000-0000-000000000002" '
    'xmlns="http://www.genicam.org/GenApi/Version_1_1">'
)
"""The first element of a description, with all that EMVA's GenApi wants of it."""

DESCRIPTION = """<?xml version="1.0" encoding="utf-8"?>
<RegisterDescription xmlns="http://www.genicam.org/GenApi/Version_1_0" ModelName="Tester">
<Group Comment="all">
<Category Name="Root"><pFeature>Image</pFeature></Category>
<Category Name="Image"><pFeature>Width</pFeature><pFeature>Height</pFeature>
<pFeature>PixelFormat</pFeature><pFeature>ExposureTime</pFeature><pFeature>ReverseX</pFeature>
<pFeature>AcquisitionFrameRate</pFeature><pFeature>Gain</pFeature><pFeature>Nothing</pFeature>
</Category>
<Integer Name="Width"><pValue>WidthReg</pValue><Min>8</Min><Max>4096</Max><Inc>8</Inc></Integer>
<IntReg Name="WidthReg"><Address>0x10000</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>
<Integer Name="Height"><pValue>HeightReg</pValue><Min>1</Min><pMax>MaxHeight</pMax></Integer>
<IntSwissKnife Name="MaxHeight"><Constant Name="HALF">1536</Constant>
<Formula>HALF * 2</Formula></IntSwissKnife>
<IntReg Name="HeightReg"><pAddress>Base</pAddress><Address>4</Address><Length>4</Length>
<AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Integer Name="Base"><Value>0x10000</Value></Integer>
<Enumeration Name="PixelFormat">
<EnumEntry Name="Mono8"><Value>0x01080001</Value></EnumEntry>
<EnumEntry Name="Mono16"><Value>0x01100007</Value><pIsAvailable>No</pIsAvailable></EnumEntry>
<EnumEntry Name="Odd8"><Value>0x01080FFF</Value></EnumEntry>
<pValue>FormatReg</pValue></Enumeration>
<IntReg Name="FormatReg"><Address>0x10008</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Integer Name="No"><Value>0</Value></Integer>
<Command Name="AcquisitionStart"><pValue>StartReg</pValue><CommandValue>1</CommandValue></Command>
<Command Name="AcquisitionStop"><pValue>StartReg</pValue><CommandValue>0</CommandValue></Command>
<IntReg Name="StartReg"><Address>0x1000C</Address><Length>4</Length><AccessMode>WO</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Float Name="AcquisitionFrameRate"><pValue>Rate</pValue><Min>0.1</Min><Max>1000</Max></Float>
<Converter Name="Rate"><FormulaTo>1000000 / FROM</FormulaTo><FormulaFrom>1000000 / TO</FormulaFrom>
<pValue>PeriodReg</pValue></Converter>
<IntReg Name="PeriodReg"><Address>0x10010</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<FloatReg Name="ExposureTime"><Address>0x10014</Address><Length>8</Length>
<AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></FloatReg>
<Boolean Name="ReverseX"><pValue>ReverseBit</pValue></Boolean>
<StructReg Comment="flags"><Address>0x1001C</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess>
<StructEntry Name="ReverseBit"><Bit>31</Bit></StructEntry>
<StructEntry Name="GainBits"><LSB>15</LSB><MSB>8</MSB><Sign>Signed</Sign></StructEntry></StructReg>
<SwissKnife Name="Gain"><pVariable Name="RAW">GainBits</pVariable>
<Formula>RAW / 10</Formula></SwissKnife>
<Integer Name="Nothing"><Value>1</Value><pIsAvailable>No</pIsAvailable></Integer>
<IntSwissKnife Name="PayloadSize"><pVariable Name="W">Width</pVariable>
<pVariable Name="H">Height</pVariable><pVariable Name="F">PixelFormat</pVariable>
<pVariable Name="X">ExtraReg</pVariable>
<Formula>W * H * ((F &gt;&gt; 16) &amp; 0xFF) / 8 + X</Formula>
</IntSwissKnife>
<IntReg Name="ExtraReg"><Address>0x10020</Address><Length>4</Length><AccessMode>RO</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<IntReg Name="TLParamsLocked"><Address>0x10024</Address><Length>4</Length>
<AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Category Name="AcquisitionControl"><pFeature>TriggerSelector</pFeature>
<pFeature>TriggerMode</pFeature><pFeature>TriggerSource</pFeature><pFeature>TriggerSoftware</pFeature>
<pFeature>UserSetSelector</pFeature><pFeature>UserSetLoad</pFeature><pFeature>UserSetSave</pFeature>
<pFeature>UserSetDefault</pFeature><pFeature>BlackLevel</pFeature></Category>
<Enumeration Name="TriggerSelector"><EnumEntry Name="FrameStart"><Value>0</Value></EnumEntry>
<EnumEntry Name="AcquisitionStart"><Value>1</Value></EnumEntry><pValue>SelectorReg</pValue>
<pSelected>TriggerMode</pSelected><pSelected>TriggerSource</pSelected></Enumeration>
<Enumeration Name="TriggerMode"><EnumEntry Name="Off"><Value>0</Value></EnumEntry>
<EnumEntry Name="On"><Value>1</Value></EnumEntry><pValue>ModeReg</pValue></Enumeration>
<Enumeration Name="TriggerSource"><EnumEntry Name="Software"><Value>0</Value></EnumEntry>
<EnumEntry Name="Line1"><Value>1</Value></EnumEntry><pValue>SourceReg</pValue></Enumeration>
<Command Name="TriggerSoftware"><pValue>SoftwareReg</pValue><CommandValue>1</CommandValue></Command>
<IntReg Name="SelectorReg"><Address>0x10100</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<IntReg Name="ModeReg"><Address>0x10110</Address><pIndex Offset="16">SelectorReg</pIndex>
<Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<IntReg Name="SourceReg"><Address>0x10114</Address><pIndex Offset="16">SelectorReg</pIndex>
<Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<IntReg Name="SoftwareReg"><Address>0x10140</Address><Length>4</Length><AccessMode>WO</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Enumeration Name="UserSetSelector"><EnumEntry Name="Default"><Value>0</Value></EnumEntry>
<EnumEntry Name="UserSet1"><Value>1</Value></EnumEntry><pValue>UserSetReg</pValue></Enumeration>
<Command Name="UserSetLoad"><pValue>LoadReg</pValue><CommandValue>1</CommandValue></Command>
<Command Name="UserSetSave"><pValue>SaveReg</pValue><CommandValue>1</CommandValue></Command>
<Enumeration Name="UserSetDefault"><EnumEntry Name="Default"><Value>0</Value></EnumEntry>
<EnumEntry Name="UserSet1"><Value>1</Value></EnumEntry><pValue>DefaultReg</pValue></Enumeration>
<IntReg Name="UserSetReg"><Address>0x10150</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<IntReg Name="LoadReg"><Address>0x10154</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<IntReg Name="SaveReg"><Address>0x10158</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<IntReg Name="DefaultReg"><Address>0x1015C</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Float Name="BlackLevel"><Description>Offset of all  pixels.</Description>
<pValue>BlackSteps</pValue>
<Min>0</Min><Max>25.5</Max><Unit>DN</Unit></Float>
<Converter Name="BlackSteps"><FormulaTo>FROM * 10</FormulaTo><FormulaFrom>TO / 10</FormulaFrom>
<pValue>BlackReg</pValue></Converter>
<IntReg Name="BlackReg"><Address>0x10160</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Category Name="ChunkDataControl"><pFeature>ChunkModeActive</pFeature>
<pFeature>ChunkExposureTime</pFeature><pFeature>ChunkFrameID</pFeature>
<pFeature>ChunkLineStatusAll</pFeature><pFeature>ChunkPixelFormat</pFeature>
<pFeature>ChunkTimestamp</pFeature></Category>
<Boolean Name="ChunkModeActive"><pValue>ChunkModeReg</pValue></Boolean>
<IntReg Name="ChunkModeReg"><Address>0x10170</Address><Length>4</Length>
<AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Float Name="ChunkExposureTime"><pIsAvailable>ChunkModeActive</pIsAvailable>
<pValue>ChunkExposureReg</pValue><Unit>us</Unit></Float>
<FloatReg Name="ChunkExposureReg"><Address>0</Address><Length>8</Length>
<AccessMode>RO</AccessMode><pPort>ExposureChunk</pPort><Endianess>BigEndian</Endianess></FloatReg>
<Integer Name="ChunkFrameID"><pValue>ChunkFrameReg</pValue></Integer>
<IntReg Name="ChunkFrameReg"><Address>4</Address><Length>4</Length>
<AccessMode>RO</AccessMode><pPort>CounterChunk</pPort><Endianess>LittleEndian</Endianess></IntReg>
<IntSwissKnife Name="ChunkLineStatusAll"><pVariable Name="BITS">ChunkLineReg</pVariable>
<Formula>BITS &amp; 0xF</Formula></IntSwissKnife>
<MaskedIntReg Name="ChunkLineReg"><Address>0</Address><Length>2</Length><AccessMode>RO</AccessMode>
<pPort>CounterChunk</pPort><LSB>15</LSB><MSB>8</MSB><Sign>Unsigned</Sign>
<Endianess>BigEndian</Endianess></MaskedIntReg>
<Enumeration Name="ChunkPixelFormat"><EnumEntry Name="Mono8"><Value>0x01080001</Value></EnumEntry>
<pValue>ChunkFormatReg</pValue></Enumeration>
<IntReg Name="ChunkFormatReg"><Address>0</Address><Length>4</Length><AccessMode>RO</AccessMode>
<pPort>FormatChunk</pPort><Endianess>BigEndian</Endianess></IntReg>
<Integer Name="ChunkTimestamp"><pValue>ChunkTimestampReg</pValue></Integer>
<IntReg Name="ChunkTimestampReg"><Address>0</Address><Length>8</Length><AccessMode>RO</AccessMode>
<pPort>MissingChunk</pPort><Endianess>BigEndian</Endianess></IntReg>
<Port Name="ExposureChunk"><ChunkID>a0000001</ChunkID></Port>
<Port Name="CounterChunk"><ChunkID>A0000002</ChunkID></Port>
<Port Name="FormatChunk"><ChunkID>3</ChunkID></Port>
<Port Name="MissingChunk"><ChunkID>A0000009</ChunkID></Port>
<Category Name="EventControl"><pFeature>EventSelector</pFeature>
<pFeature>EventNotification</pFeature><pFeature>EventExposureEnd</pFeature>
<pFeature>EventExposureEndTimestamp</pFeature><pFeature>EventExposureEndFrameID</pFeature>
<pFeature>EventExposureEndLines</pFeature><pFeature>EventFrameTriggerMissed</pFeature>
<pFeature>EventPlain</pFeature></Category>
<Enumeration Name="EventSelector"><EnumEntry Name="ExposureEnd"><Value>0</Value></EnumEntry>
<EnumEntry Name="FrameTriggerMissed"><Value>1</Value></EnumEntry>
<EnumEntry Name="Plain"><Value>2</Value></EnumEntry><pValue>EventReg</pValue></Enumeration>
<IntReg Name="EventReg"><Address>0x10180</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Enumeration Name="EventNotification"><EnumEntry Name="Off"><Value>0</Value></EnumEntry>
<EnumEntry Name="On"><Value>1</Value></EnumEntry><pValue>NotifyReg</pValue></Enumeration>
<IntReg Name="NotifyReg"><Address>0x10190</Address><pIndex Offset="4">EventReg</pIndex>
<Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>
<Integer Name="EventExposureEnd"><Value>0x9002</Value></Integer>
<Integer Name="EventFrameTriggerMissed"><Value>0x9003</Value></Integer>
<Integer Name="EventPlain"><Value>0x9004</Value></Integer>
<Integer Name="EventExposureEndTimestamp"><pValue>EndTimeReg</pValue></Integer>
<IntReg Name="EndTimeReg"><Address>8</Address><Length>8</Length><AccessMode>RO</AccessMode>
<pPort>EndPort</pPort><Endianess>BigEndian</Endianess></IntReg>
<Integer Name="EventExposureEndFrameID"><pValue>EndFrameReg</pValue></Integer>
<IntReg Name="EndFrameReg"><Address>6</Address><Length>2</Length><AccessMode>RO</AccessMode>
<pPort>EndPort</pPort><Endianess>BigEndian</Endianess></IntReg>
<Integer Name="EventExposureEndLines"><pValue>EndLinesReg</pValue></Integer>
<IntReg Name="EndLinesReg"><Address>16</Address><Length>4</Length><AccessMode>RO</AccessMode>
<pPort>EndPort</pPort><Endianess>BigEndian</Endianess></IntReg>
<Port Name="EndPort"><EventID>9002</EventID></Port>
<Port Name="Device"/>
</Group>
</RegisterDescription>
"""


@dataclass
class Mischief:
    """Random faults of packets.

    Attributes:
        seed: seed of the random numbers.
        drop: share of packets that are lost, resent ones included.
        double: share of packets that come twice.
        reorder: a packet may come this many places late.
        resend: "answer", "ignore", or "refuse": by PACKET_UNAVAILABLE.
        restart_at: number of the frame before which the block ids restart.
        stop_after: number of the frame in the middle of which the camera is unplugged.
        skip: numbers of frames of which nothing is sent.
    """

    seed: int = 0
    drop: float = 0.0
    double: float = 0.0
    reorder: int = 0
    resend: str = "answer"
    restart_at: int | None = None
    stop_after: int | None = None
    skip: frozenset[int] = frozenset()


@dataclass
class Camera:
    """See :func:`camera`.

    Attributes:
        port: port of the camera.
        mischief: faults of the packets.
        extended: whether block ids have 64 bits.
        first_id: id of the first block.
        test_packets: size of the largest that come through; 0: no test packets.
        packed: whether the description is zipped.
        ticks: ticks of the clock in a second; 0: no clock.
        pending: seconds by which each request is put off.
        deaf: whether no request is answered.
        refuse: status of the answer to writes, by address.
        taken_by: address of another application that controls the camera.
        mute_when_taken: whether there is no answer in place of ACCESS_DENIED, as from aravis' fake
            camera.
        payload_type: payload type in leader and trailer.
        chunk_type: the same while the camera sends chunk data: 0x4001, 4 or 5.
        latches: whether the clock can be read by a register.
        plan: outcomes of the next triggers, one after the other: "" for a picture, "ignore",
            "busy", "missed" by an event, "lose" for no packet, "cut" for a packet that never comes,
            "double" for two pictures, "late SECONDS" for an exposure that begins late, and not once
            it was stopped, "slow SECONDS" for a picture that is sent long after its exposure, even
            into the next stream, "early" for an untriggered picture right before.
        tells_events: whether the camera has events.
        lose_acks: number of acknowledgements of events that are lost.
        acked: ids of the events that were acknowledged.
        exposed: number of the picture by the number of the trigger that caused it.
        sent: numbers of the frames whose sending began.
        asked: packets that were requested again.
    """

    mischief: Mischief = field(default_factory=Mischief)
    extended: bool = False
    first_id: int = 1
    test_packets: int = 1500
    packed: bool = False
    ticks: int = 1_000_000
    pending: float = 0.0
    deaf: bool = False
    refuse: dict[int, int] = field(default_factory=dict)
    taken_by: str | None = None
    mute_when_taken: bool = False
    payload_type: int = 1
    chunk_type: int = 0x4001
    description: bytes = DESCRIPTION.encode()
    url: bytes = b""
    heartbeat: float = 3.0
    port: int = 0
    sent: list[int] = field(default_factory=list)
    asked: list[tuple[int, int, int]] = field(default_factory=list)
    requests: int = 0
    streaming: bool = False
    dropped: int = 0
    latches: bool = True
    plan: list[str] = field(default_factory=list)
    triggers: int = 0
    starts: int = 0
    tells_events: bool = True
    lose_acks: int = 0
    acked: list[int] = field(default_factory=list)
    event_ids_off: int = 0
    address: str = "127.0.0.1"
    forced: tuple[str, ...] = ()
    answer_forceip_only: bool = False
    exposed: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.words: dict[int, int] = {
            WIDTH: 64, HEIGHT: 48, FORMAT: MONO8, PERIOD: 10_000, FLAGS: 0x00FB0000,
            PAYLOAD_EXTRA: 0, LOCKED: 0, EXPOSURE: 0x408F4000, EXPOSURE + 4: 0,
            0x934: 0x6, 0x938: int(self.heartbeat * 1000), 0x93C: 0, 0x940: self.ticks,
            0xA00: 0, 0xA14: 0, 0xD00: 0, 0xD04: 1400, 0xD18: 0, 0x944: 0, 0x948: 0, 0x94C: 0,
            CHUNKS: 0, LINES: 0x5, EVENT: 0, 0xB00: 0, 0xB10: 0, 0xB14: 0, 0xB18: 0,
            **dict.fromkeys(range(NOTIFY, NOTIFY + 12, 4), 0),
            SELECTOR: 0, USER_SET: 0, USER_LOAD: 0, USER_SAVE: 0, USER_DEFAULT: 0, BLACK: 0,
            **dict.fromkeys(range(TRIGGERS, TRIGGERS + 32, 4), 0),
        }  # fmt: skip
        self.kept: dict[int, dict[int, int]] = {0: dict(self.words)}
        self.event_id = 0
        self.messages: asyncio.DatagramTransport | None = None
        self._exposures: set[asyncio.Task[None]] = set()
        data = self.description
        if not self.tells_events:
            data = data.replace(b'"EventSelector"', b'"NoSelector"')
        if self.packed:
            file = BytesIO()
            with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("tester.xml", data)
            data = file.getvalue()
        name = "tester.zip" if self.packed else "tester.xml"
        url = self.url or f"Local:{name};{XML_ADDRESS:x};{len(data):x}".encode()
        self.memory = {
            0x48: _texts((b"Maker", 32), (b"Tester", 32), (b"1", 32), (b"", 48), (b"T1", 16),
                         (b"", 16)),
            0x200: url.ljust(512, b"\0") + bytes(512),
            XML_ADDRESS: data.ljust(len(data) + 512, b"\0"),
        }  # fmt: skip
        self.dice = random.Random(self.mischief.seed)  # noqa: S311 - it is to come again
        self.number = self.locked_at_start = 0
        self.last = 1 << 62  # frame, after which it sends none; then it is done
        self.done = asyncio.Event()
        self.block = self.first_id - 1
        self.owner: object = None
        self.heard = 0.0
        self.history: dict[int, list[bytes]] = {}
        self.stream: socket.socket | None = None
        self._task: asyncio.Task[None] | None = None
        self.transport: asyncio.DatagramTransport | None = None

    # control

    def received(self, data: bytes, sender: tuple[str, int]) -> None:
        key, flags, command, length, request = struct.unpack_from(">BBHHH", data)
        assert (key, length) == (0x42, len(data) - 8), data.hex()
        if self.deaf:
            return
        if command == 0x04 and data[10:16] != MAC:
            return
        self.requests += 1
        if sender == self.owner:
            self.heard = asyncio.get_running_loop().time()
        payload = data[8:]
        if command == 0x40:
            self.again(payload, bool(flags & 0x10))
            return
        status, answer = self.answer(command, payload, sender)
        if status == 0x8006 and self.mute_when_taken:
            return
        if self.pending:
            pending = struct.pack(">HH", 0, int(self.pending * 1000))
            self.reply(sender, 0, 0x89, request, pending)
            loop = asyncio.get_running_loop()
            loop.call_later(self.pending, self.reply, sender, status, command + 1, request, answer)
        else:
            self.reply(sender, status, command + 1, request, answer)

    def reply(
        self, to: tuple[str, int], status: int, command: int, request: int, answer: bytes
    ) -> None:
        if self.transport is not None and not self.transport.is_closing():
            header = struct.pack(">HHHH", status, command, len(answer), request)
            self.transport.sendto(header + answer, to)

    def answer(self, command: int, payload: bytes, sender: tuple[str, int]) -> tuple[int, bytes]:
        if command == 0x04:
            assert len(payload) == 56
            assert payload[2:8] == MAC
            assert not any(payload[:2] + payload[8:20] + payload[24:36] + payload[40:52])
            if self.owner is not None:
                return 0x8006, b""
            self.forced = tuple(socket.inet_ntoa(payload[at : at + 4]) for at in (20, 36, 52))
            if not self.answer_forceip_only:
                self.address = self.forced[0]
            return 0, b""
        if command == 0x02:
            info = bytearray(0xF8)
            info[0x0A:0x10] = MAC
            info[0x24:0x28] = socket.inet_aton(self.address)
            info[0x48:0xF8] = self.memory[0x48]
            return 0, bytes(info)
        if command == 0x80:
            words = [self.words.get(one) for (one,) in struct.iter_unpack(">I", payload)]
            if None in words:
                return 0x8003, b""
            return 0, struct.pack(f">{len(words)}I", *cast("list[int]", words))
        if command == 0x84:
            address, _, count = struct.unpack(">IHH", payload)
            found = self.read(address, count)
            return (0x8003, b"") if found is None else (0, payload[:4] + found)
        pairs = list(struct.iter_unpack(">II", payload)) if command == 0x82 else []
        if command == 0x86:
            (address,) = struct.unpack_from(">I", payload)
            pairs = [(address + at, value) for at, (value,) in
                     zip(range(0, len(payload), 4), struct.iter_unpack(">I", payload[4:]),
                         strict=False)]  # fmt: skip
        for address, value in pairs:
            status = self.write(address, value, sender)
            if status:
                return status, b""
        return 0, struct.pack(">HH", 0, len(pairs))

    def read(self, address: int, count: int) -> bytes | None:
        for begin, data in self.memory.items():
            if begin <= address and address + count <= begin + len(data):
                return data[address - begin :][:count]
        words = [self.words.get(one) for one in range(address, address + count, 4)]
        return None if None in words else struct.pack(f">{len(words)}I", *words)

    def write(self, address: int, value: int, sender: tuple[str, int]) -> int:
        if address in self.refuse:
            return self.refuse[address]
        if self.taken_by is not None or self.owner not in (None, sender):
            return 0x8006
        if address == 0xA00:
            self.owner = sender if value else None
            self.words[0xA00] = value
            self.heard = asyncio.get_running_loop().time()
        elif self.owner is None:
            return 0x8006
        if address not in self.words and address not in (START, SOFTWARE):
            return 0x8003
        if address == SOFTWARE:
            return self.pull(0)
        if address == 0x944 and not self.latches:
            return 0x8003
        if address == 0x944 and value & 2:
            ticks = self.clock()
            self.words[0x948], self.words[0x94C] = ticks >> 32, ticks & 0xFFFFFFFF
            return 0
        if address == START:
            self.locked_at_start = self.words[LOCKED]
            (self.start if value else self.stop)()
            return 0
        if address == CHUNKS:
            self.payload_type = self.chunk_type if value else 1
            self.words[PAYLOAD_EXTRA] = len(self.chunks(0)) if value else 0
        if address in (USER_LOAD, USER_SAVE):
            asyncio.get_running_loop().call_later(0.1, self.user_set, address)
        self.words[address] = value & 0xFFFF if address == 0xD04 else value
        if address == 0xD04 and value >> 31 and (value & 0xFFFF) <= self.test_packets:
            self.send(bytes((value & 0xFFFF) - 28))
        return 0

    def take_away(self, by: str) -> None:
        """Give control to another application."""
        self.taken_by, self.owner = by, None
        self.words[0xA00] = 0
        self.words[0xA14] = int.from_bytes(socket.inet_aton(by), "big")

    def user_set(self, command: int) -> None:
        """Load or save a user set; the command's register shows when that is done."""
        self.words[command] = 0
        place = self.words[USER_SET]
        if command == USER_SAVE:
            self.kept[place] = {one: self.words[one] for one in (BLACK, EXPOSURE, EXPOSURE + 4)}
        else:
            kept = self.kept.get(place, {})
            self.words |= {one: kept[one] for one in (BLACK, EXPOSURE, EXPOSURE + 4) if one in kept}

    # events

    def tell(self, name: str, block: int = 0, data: bytes = b"", ticks: int | None = None) -> None:
        """Send an event until it is acknowledged, if the event is switched on."""
        place, number = EVENTS[name]
        if not self.words[NOTIFY + 4 * place] or not self.words[0xB00]:
            return
        self.event_id = self.event_id % 0xFFFF + 1
        at = self.clock() if ticks is None else ticks
        if self.extended:
            item = struct.pack(">HHHHQQ", 24 + len(data), number, 0, 0, block, at) + data
        else:
            item = struct.pack(">HHHHQ", 0, number, 0, block & 0xFFFF, at) + data
        header = struct.pack(">BBHHH", 0x42, 0x11 if self.extended else 1, 0xC2 if data else 0xC0,
                             len(item), self.event_id)  # fmt: skip
        self._send_event(header + item, self.event_id, 1 + self.words[0xB18])

    def _send_event(self, datagram: bytes, number: int, tries: int) -> None:
        if number in self.acked or not tries or self.deaf or self.messages is None:
            return
        to = socket.inet_ntoa(self.words[0xB10].to_bytes(4, "big"))
        self.messages.sendto(datagram, (to, self.words[0xB00]))
        asyncio.get_running_loop().call_later(
            self.words[0xB14] / 1e3, self._send_event, datagram, number, tries - 1
        )

    def event_acked(self, data: bytes) -> None:
        status, command, length, number = struct.unpack(">HHHH", data)
        assert (status, length) == (0, 0)
        assert command in (0xC1, 0xC3)
        if self.lose_acks:
            self.lose_acks -= 1
        else:
            self.acked.append(number)

    # triggers

    @property
    def is_triggered(self) -> bool:
        return any(self.words[TRIGGERS + 16 * kind] for kind in (0, 1))

    def pull(self, source: int) -> int:
        """Handle a trigger, by software (0) or by a line (1); return the status of the answer."""
        if not self.words[TRIGGERS] or self.words[TRIGGERS + 4] != source or not self.streaming:
            return 0 if source else 0x8006
        what = self.plan.pop(0) if self.plan else ""
        if what == "busy":
            return 0x8007
        self.triggers += 1
        if what == "missed":
            self.tell("FrameTriggerMissed")
            return 0
        task = asyncio.ensure_future(self._exposed(self.triggers, what))
        self._exposures.add(task)
        task.add_done_callback(self._exposures.discard)
        return 0

    async def _exposed(self, trigger: int, what: str) -> None:
        if what == "ignore":
            return
        if what == "early":
            self.expose(ticks=self.clock() - self.ticks)
        starts = self.starts
        await asyncio.sleep(float(what.split()[1]) if what.startswith("late") else 0.002)
        if starts != self.starts or not self.streaming:
            return
        ticks = self.clock()
        number, block = self.counted()
        self.exposed[trigger] = number
        lines = struct.pack(">I", self.words[LINES])
        self.tell("ExposureEnd", block + self.event_ids_off, lines)
        await asyncio.sleep(float(what.split()[1]) if what.startswith("slow") else 0.005)
        self.show(number, block, what, ticks)
        if what == "double":
            self.expose(ticks=ticks)

    def clock(self) -> int:
        return int((1000 + asyncio.get_running_loop().time()) * self.ticks)

    # stream

    def start(self) -> None:
        self.stop()
        self.starts += 1
        self.streaming = True
        self._task = asyncio.create_task(self._run(), name="camera")

    def stop(self) -> None:
        self.streaming = False
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(self.words[PERIOD] / 1e6)
            if loop.time() - self.heard > self.heartbeat:
                self.words[0xA00], self.owner, self.streaming = 0, None, False
                return
            if self.is_triggered:
                continue
            if self.number + 1 > self.last:
                self.number += 1
                self.done.set()
                return
            self.expose()
            if self.number == self.mischief.stop_after:
                self.deaf = True
                return

    def expose(self, what: str = "", ticks: int | None = None) -> None:
        """Take and send a picture."""
        self.show(*self.counted(), what, ticks)

    def counted(self) -> tuple[int, int]:
        """Return the number and the block of the next picture."""
        self.number += 1
        self.block += 1
        if self.block > 0xFFFF and not self.extended:
            self.block = 1
        if self.number == self.mischief.restart_at:
            self.block = 1
        return self.number, self.block

    def show(self, number: int, block: int, what: str = "", ticks: int | None = None) -> None:
        """Send a picture."""
        if number in self.mischief.skip or what == "lose":
            return
        packets = self.packets(number, block, ticks)
        self.history[block] = packets
        for old in list(self.history)[:-8]:
            del self.history[old]
        self.sent.append(number)
        order = self.misdone(packets)
        if number == self.mischief.stop_after:
            order = order[: len(order) // 2]
        if what == "cut":
            self.history[block] = packets[:1]
            del order[1:2]
        for one in order:
            self.send(one)

    def picture(self, number: int) -> bytes:
        bits = self.words[FORMAT] >> 16 & 0xFF
        rows = np.full((self.words[HEIGHT], self.words[WIDTH] * bits // 8), number % 251, np.uint8)
        rows[:, :4] = np.frombuffer(struct.pack(">I", number), np.uint8)
        rows[:, 4] = np.arange(len(rows)) % 256
        if self.words[CHUNKS]:
            return rows.tobytes() + self.chunks(number)
        return rows.tobytes() + bytes(self.words[PAYLOAD_EXTRA])

    def chunks(self, number: int) -> bytes:
        """Return the bytes after the pixels: the end of their chunk, and three more chunks."""
        pixels = self.words[HEIGHT] * self.words[WIDTH] * (self.words[FORMAT] >> 16 & 0xFF) // 8
        exposure = struct.pack(">II", self.words[EXPOSURE], self.words[EXPOSURE + 4])
        counter = struct.pack(">HHI", 0xFF00 | self.words[LINES], 0, 0)[:4] + struct.pack(
            "<I", number
        )
        parts = [(1, b"", pixels), (0xA0000001, exposure, 8), (0xA0000002, counter, 8),
                 (3, struct.pack(">I", self.words[FORMAT]), 4)]  # fmt: skip
        return b"".join(data + struct.pack(">II", id_, size) for id_, data, size in parts)

    def packets(self, number: int, block: int, ticks: int | None = None) -> list[bytes]:
        def header(kind: int, packet: int) -> bytes:
            if self.extended:
                return struct.pack(">HHIQI", 0, 0, (kind | 0x80) << 24, block, packet)
            return struct.pack(">HHI", 0, block, kind << 24 | packet)

        data = self.picture(number)
        full = self.words[0xD04] - 28 - len(header(1, 0))
        parts = [data[at : at + full] for at in range(0, len(data), full)]
        ticks = self.clock() if ticks is None else ticks
        leader = struct.pack(
            ">HHQIIIIIHH", 0, self.payload_type, ticks, self.words[FORMAT], self.words[WIDTH],
            self.words[HEIGHT], 0, 0, 0, 0,
        )  # fmt: skip
        sizes = {4: (len(data),), 5: (len(data), self.words[HEIGHT], 7)}.get(
            self.payload_type, (self.words[HEIGHT],)
        )
        trailer = struct.pack(f">HH{len(sizes)}I", 0, self.payload_type, *sizes)
        if self.payload_type == 4:  # chunk data of the first version: no size
            leader = leader[:12]
        payload = [header(3, 1 + at) + part for at, part in enumerate(parts)]
        return [header(1, 0) + leader, *payload, header(2, len(parts) + 1) + trailer]

    def misdone(self, packets: list[bytes]) -> list[bytes]:
        it, dice = self.mischief, self.dice
        kept = []
        for at, one in enumerate(packets):
            if dice.random() < it.drop:
                self.dropped += 1
                continue
            times = 1 + (dice.random() < it.double)
            kept += [(at + dice.uniform(0, it.reorder), one) for _ in range(times)]
        return [one for _, one in sorted(kept, key=lambda pair: pair[0])]

    def again(self, payload: bytes, extended: bool) -> None:
        assert extended == self.extended
        _, block, first, last = struct.unpack_from(">HHII", payload)
        if extended:
            (block,) = struct.unpack_from(">Q", payload, 12)
        self.asked.append((block, first, last))
        if self.mischief.resend == "ignore":
            return
        there = self.history.get(block, [])
        for packet in range(first, last + 1):
            if self.mischief.resend == "refuse" or packet >= len(there):
                status = struct.pack(">H", 0x800C)
                if extended:
                    header = struct.pack(">HIQI", 0, 0x83 << 24, block, packet)
                else:
                    header = struct.pack(">HI", block, 0x03 << 24 | packet)
                self.send(status + header)
            elif self.dice.random() >= self.mischief.drop:
                self.send(struct.pack(">H", 0x0100) + there[packet][2:])

    def send(self, packet: bytes) -> None:
        if self.stream is not None and self.words[0xD00] and not self.deaf:
            to = socket.inet_ntoa(self.words[0xD18].to_bytes(4, "big"))
            self.stream.sendto(packet, (to, self.words[0xD00]))


def _texts(*parts: tuple[bytes, int]) -> bytes:
    return b"".join(text.ljust(size, b"\0") for text, size in parts)


def number_in(frame: Any) -> int:
    """Return a frame's number; fail for rows of two frames, or for a row at a wrong place."""
    rows = np.frombuffer(frame.data, np.uint8).reshape(frame.height, frame.stride)
    numbers = rows[:, :4].copy().view(">u4")[:, 0]
    assert len(set(numbers.tolist())) == 1, f"rows of the frames {sorted(set(numbers.tolist()))}"
    number = int(numbers[0])
    assert (rows[:, 4] == np.arange(frame.height) % 256).all()
    assert (rows[:, 5:] == number % 251).all()
    return number


class _Wire(asyncio.DatagramProtocol):
    def __init__(self, inside: Camera) -> None:
        self._inside = inside

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self._inside.received(data, addr)


class _Messages(asyncio.DatagramProtocol):
    def __init__(self, inside: Camera) -> None:
        self._inside = inside

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self._inside.event_acked(data)


@asynccontextmanager
async def camera(**options: Any) -> AsyncIterator[Camera]:
    """Run a camera on 127.0.0.1; the options are those of :class:`Camera`."""
    inside = Camera(**options)
    loop = asyncio.get_running_loop()
    transport, _ = await loop.create_datagram_endpoint(
        lambda: _Wire(inside), local_addr=("127.0.0.1", 0)
    )
    inside.transport = transport
    inside.port = transport.get_extra_info("sockname")[1]
    inside.messages, _ = await loop.create_datagram_endpoint(
        lambda: _Messages(inside), local_addr=("127.0.0.1", 0)
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stream:
        stream.bind(("127.0.0.1", 0))
        inside.stream = stream
        try:
            yield inside
        finally:
            inside.stop()
            for exposure in [*inside._exposures]:
                exposure.cancel()
            transport.abort()
            inside.messages.abort()
            await asyncio.sleep(0)
