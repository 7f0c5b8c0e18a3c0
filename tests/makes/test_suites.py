"""Run smartcam's suite for protocols with bytes from the makes' documents."""

from __future__ import annotations

from smartcam.exceptions import FrameError
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr
from smartcam.models import Status
from smartcam.protocols import LineCommand, LineReply
from smartcam.protocols import messages as m
from smartcam.testing import Conversation, Received, Sent, WireSuite

READY = Status.RUNNING | Status.WAITING_FOR_TRIGGER
APPLICATION_7 = "003\t07\t01\t07\t12"
IDENTITY = "IFM ELECTRONIC\tO2D500\tname\tplace\t\t192.168.0.69\t255.255.255.0\t192.168.0.201"


def v3(ticket: int | str, content: str) -> bytes:
    """Return a frame of version 3."""
    body = f"{ticket}{content}\r\n".encode("latin-1")
    return f"{ticket}L{len(body):09}\r\n".encode() + body


def v4(content: str) -> bytes:
    """Return a frame of version 4."""
    return f"L{len(content) + 2:09}\r\n{content}\r\n".encode()


def result(application: int, data: bytes, mixed: str = "") -> m.ResultContainer:
    """Return a result of an application, or one that may be of any of ``mixed``."""
    fault = f"the application changed while the result was made: it may be of any of {mixed}"
    return m.ResultContainer(application=application, data=data, fault=fault if mixed else None)


def code(line: str) -> m.ResultContainer:
    """Return the event for a reader's line."""
    read = line != "ERROR"
    cells = (m.CellValue("read", str(int(read))), m.CellValue("code", line if read else ""))
    return m.ResultContainer(data=line.encode(), cells=cells)


V3_SESSION = (
    Sent(m.Connect(), b"1000L000000008\r\n1000G?\r\n"),
    Received(v3(1000, IDENTITY), (), b"1001L000000008\r\n1001p7\r\n"),
    Received(v3(1001, "*"), (m.ConnectAnswer(version=1),)),
)


class TestPcicWire(WireSuite):
    protocol = EmulatedIfm.protocol
    conversations = (
        Conversation(
            name="a trigger by its ticket, and what the device says meanwhile",
            dialect="v3",
            steps=[
                *V3_SESSION,
                Sent(m.GetStatus(), v3(1002, "E?")),
                Received(v3(1002, "000000000"), (m.StatusReport(status=READY),)),
                Sent(m.Query(), v3(1003, "A?")),
                Received(v3(1003, "003\t07\t01\t07\t12"), (m.QueryAnswer(application=7),)),
                Sent(m.Trigger(), v3(1004, "A?") + v3(1005, "T?")),
                Sent(m.Query(), v3(1006, "A?")),
                Received(v3("0000", "star;old;stop"), ()),
                Received(v3(1004, APPLICATION_7), (), v3(1007, "A?")),
                Received(v3(1006, APPLICATION_7), ()),
                Received(
                    v3(1007, APPLICATION_7),
                    (result(7, b"star;old;stop"), m.QueryAnswer(application=7)),
                ),
                Received(
                    v3("0001", "110001006:Trigger overrun"),
                    (m.Notice("error", 110001006, "Trigger overrun"),),
                ),
                Received(v3("0010", "000500000:{}"), (m.Notice("notification", 500000, "{}"),)),
                Received(v3(1005, "star;\r\n\xff;stop"), (), v3(1008, "A?")),
                Received(v3("0010", "000500002:{}"), ()),
                Received(
                    v3(1008, APPLICATION_7),
                    (
                        m.TriggerAnswer(),
                        result(7, b"star;\r\n\xff;stop"),
                        m.Notice("notification", 500002, "{}"),
                    ),
                ),
            ],
        ),
        Conversation(
            name="requests of several questions",
            dialect="v3",
            steps=[
                *V3_SESSION,
                Sent(m.SwitchApplication(application=12), v3(1002, "a12")),
                Received(v3(1002, "*"), (), v3(1003, "A?")),
                Received(v3(1003, "003\t12\t01\t07\t12"), (m.SwitchAnswer(application=12),)),
                Sent(m.ReadImage(), v3(1004, "I01?")),
                Received(v3(1004, "!"), (), v3(1005, "I02?")),
                Received(v3(1005, "!"), (m.Image(code=1, data=b""),)),
                Sent(m.SetInput(data=b"bolt"), v3(1006, "j00000000004bolt")),
                Received(v3(1006, "*"), (m.SetInputAnswer(),)),
                Sent(m.Trigger(), v3(1007, "A?") + v3(1008, "T?")),
                Received(v3(1008, "!"), (m.TriggerAnswer(code=4),)),
                Sent(LineCommand(line="S?"), v3(1009, "S?")),
                Received(v3(1009, "?"), (LineReply(code=2, data=b"?"),)),
                Received(v3(1010, "*"), (FrameError,)),
            ],
        ),
        Conversation(
            name="asynchronous triggers",
            dialect="v3",
            parameters={"trigger": "async"},
            steps=[
                *V3_SESSION,
                Sent(m.Trigger(), v3(1002, "A?") + v3(1003, "t")),
                Received(v3(1002, APPLICATION_7), ()),
                Received(v3(1003, "*"), (m.TriggerAnswer(),)),
                Received(
                    v3("0001", "110001006:Trigger overrun"),
                    (
                        m.Notice("error", 110001006, "Trigger overrun"),
                        m.StatusReport(status=READY | Status.OVERTRIGGERED),
                        m.StatusReport(status=READY),
                    ),
                ),
                Received(v3("0000", "star;1;stop"), (), v3(1004, "A?")),
                Received(v3("0000", "star;2;stop"), ()),
                Received(v3(1004, APPLICATION_7), (result(7, b"star;1;stop"),), v3(1005, "A?")),
                Received(v3(1005, "003\t12\t01\t07\t12"), (result(12, b"star;2;stop", "7, 12"),)),
            ],
        ),
        Conversation(
            name="no frame",
            dialect="v3",
            steps=[*V3_SESSION, Received(b"1002L00000000x\r\n", (FrameError,))],
        ),
        Conversation(
            name="a length that is not kept",
            dialect="v3",
            steps=[*V3_SESSION, Received(b"0000L000000008\r\n0000abcd", (FrameError,))],
        ),
        Conversation(
            name="v4: answers in order, with their length",
            dialect="v4",
            steps=[
                Sent(m.Connect(), b"G?\r\n"),
                Received(v4(IDENTITY), (), b"p0\r\n"),
                Received(v4("*"), (m.ConnectAnswer(version=1),)),
                Sent(m.Trigger(), b"A?\r\n"),
                Sent(m.Query(), b""),
                Received(v4("001\t01\t01"), (), b"T?\r\n"),
                Received(v4("star;1;stop"), (), b"A?\r\n"),
                Received(v4("001\t01\t01"), (), b"A?\r\n"),
                Received(
                    v4("001\t01\t01"),
                    (m.TriggerAnswer(), result(1, b"star;1;stop"), m.QueryAnswer(application=1)),
                ),
            ],
        ),
        Conversation(
            name="v2: tickets, no length",
            dialect="v2",
            steps=[
                Sent(m.Connect(), b"1000G?\r\n"),
                Received(f"1000{IDENTITY}\r\n".encode(), (), b"1001p7\r\n"),
                Received(b"1001*\r\n", (m.ConnectAnswer(version=1),)),
                Sent(m.Trigger(), b"1002A?\r\n1003T?\r\n"),
                Received(f"1002{APPLICATION_7}\r\n".encode(), ()),
                Received(b"0000star;old;stop\r\n", (), b"1004A?\r\n"),
                Received(b"1003!\r\n", ()),
                Received(
                    f"1004{APPLICATION_7}\r\n".encode(),
                    (result(7, b"star;old;stop"), m.TriggerAnswer(code=4)),
                ),
            ],
        ),
        Conversation(
            name="v1: neither",
            dialect="v1",
            steps=[
                Sent(m.Connect(), b"G?\r\n"),
                Received(f"{IDENTITY}\r\n".encode(), (), b"p0\r\n"),
                Received(b"*\r\n", (m.ConnectAnswer(version=1),)),
                Sent(m.Query(), b"A?\r\n"),
                Received(b"!\r\n", (m.QueryAnswer(application=m.UNNAMED_APPLICATION),)),
            ],
        ),
    )


class TestIv3Wire(WireSuite):
    protocol = EmulatedIv3.protocol
    conversations = (
        Conversation(
            name="triggers, programs and errors",
            dialect="lines",
            steps=[
                Sent(m.Connect(), b"RT\r"),
                Received(b"ER,RT,03\r", (m.ConnectAnswer(version=1), m.StatusReport(status=READY))),
                Sent(m.Query(), b"PR\r"),
                Received(b"PR,099\r", (m.QueryAnswer(application=99),)),
                Sent(m.Trigger(), b"PR\r"),
                Sent(m.Query(), b""),
                Received(b"PR,098\r", (), b"T2\r"),
                Received(b"RT,00003,NG,01,OK,0000095\r", (), b"PR\r"),
                Received(b"PR,098\r", (), b"PR\r"),
                Received(
                    b"PR,098\r",
                    (
                        m.TriggerAnswer(),
                        m.ResultContainer(
                            application=98,
                            data=b"RT,00003,NG,01,OK,0000095",
                            cells=(
                                m.CellValue("count", "00003"),
                                m.CellValue("judgement", "0"),
                                m.CellValue("tool 01", "01"),
                                m.CellValue("tool 01 judgement", "1"),
                                m.CellValue("tool 01 rate", "0000095"),
                            ),
                        ),
                        m.QueryAnswer(application=98),
                    ),
                ),
                Sent(m.SwitchApplication(application=7), b"PW,7\r"),
                Received(b"ER,PW,22\r", (), b"PR\r"),
                Received(b"PR,099\r", (m.SwitchAnswer(code=22, application=99),)),
                Sent(m.Trigger(), b"PR\r"),
                Received(b"PR,099\r", (), b"T2\r"),
                Received(b"ER,T2,03\r", (m.TriggerAnswer(code=3),)),
                Sent(LineCommand(line="DR,03,0"), b"DR,03,0\r"),
                Received(b"DR,03,0,0023250\r", (LineReply(data=b"DR,03,0,0023250"),)),
            ],
        ),
        Conversation(
            name="an answer to something else",
            dialect="lines",
            steps=[
                Sent(m.Connect(), b"RT\r"),
                Received(
                    b"RT,00000,NG\r", (m.ConnectAnswer(version=1), m.StatusReport(status=READY))
                ),
                Sent(m.Query(), b"PR\r"),
                Received(b"PW\r", (FrameError,)),
            ],
        ),
    )


class TestSrWire(WireSuite):
    protocol = EmulatedSr.protocol
    conversations = (
        Conversation(
            name="readings, with other answers between",
            dialect="lines",
            parameters={"bank": "3"},
            steps=[
                Sent(m.Connect(), b"ERRSTAT\r"),
                Received(b"OK,ERRSTAT,NONE\r", (m.ConnectAnswer(version=1),)),
                Sent(m.GetStatus(), b"BUSYSTAT\r"),
                Received(b"OK,BUSYSTAT,NONE\r", (m.StatusReport(status=READY),)),
                Sent(m.Trigger(), b"LON,03\r"),
                Sent(m.Query(), b"NUM\r"),
                Received(b"OK,NUM,1,0\r", (m.QueryAnswer(application=3),)),
                Received(b"4006381333931\r", (m.TriggerAnswer(), code("4006381333931"))),
                Received(b"4012345678901\r", (code("4012345678901"),)),
                Sent(m.Trigger(), b"LON,03\r"),
                Sent(m.EndTrigger(), b"LOFF\r"),
                Received(b"ERROR\r", (m.TriggerAnswer(), code("ERROR"))),
                Sent(m.Trigger(), b"LON,03\r"),
                Received(b"ER,LON,20\r", (m.TriggerAnswer(code=20),)),
                Received(b"ER,LOFF,20\r", (m.Notice("error", 20, "ER,LOFF,20"),)),
                Sent(LineCommand(line="BCLR"), b"BCLR\r"),
                Received(b"ER,BCLR,00\r", (LineReply(code=100, data=b"ER,BCLR,00"),)),
            ],
        ),
        Conversation(
            name="an error that belongs to nothing",
            dialect="lines",
            steps=[
                Sent(m.Connect(), b"ERRSTAT\r"),
                Received(b"OK,ERRSTAT,NONE\r", (m.ConnectAnswer(version=1),)),
                Received(b"ER,XYZ,00\r", (FrameError,)),
            ],
        ),
    )
