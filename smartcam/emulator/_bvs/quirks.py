"""The open questions about real cameras, as options.

Each field is one open question: its default is the emulator's choice, its description gives the
reason and its grade. Grades: *published* in a manual of this product or a related one, *inferred*,
*recommended* (nothing is known; some choice had to be made).

``device.py`` and ``behaviour.py`` in this folder implement most of them; the link and the camera
implement ``bad_frame`` and ``second_client``, ``protocols/_bvs.py`` those of ``of_the_wire``.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from smartcam.emulator._data import EmulatorData, Seconds


class Quirks(EmulatorData):
    """Behaviour that the documents leave open. Times are seconds."""

    switch_while_running: Literal["refuse", "ignore", "allow"] = Field(
        default="refuse",
        description=(
            "A switch while the application runs: refused with code 1, not answered, or done. "
            "The application must be stopped first (SC manual p. 34, published); what happens "
            "otherwise is unknown (refuse: recommended)."
        ),
    )
    switch_answer: Literal["after_status", "before_status"] = Field(
        default="after_status",
        description=(
            "Whether the answer to a switch comes after or before the status in which BUSY has "
            "fallen. The answer comes after the switch (SC manual p. 34, published); its order "
            "with the status is unknown (after_status: recommended)."
        ),
    )
    waiting_before_result: bool = Field(
        default=False,
        description=(
            "Whether Waiting for Trigger rises before the result is sent. The order is unknown "
            "(result first: recommended)."
        ),
    )
    busy_while_processing: bool = Field(
        default=False,
        description=(
            "Whether BUSY is set during an inspection. Published only for the time of a switch "
            "(SC manual p. 33); during an inspection unknown (off: recommended)."
        ),
    )
    hidden_triggers: bool = Field(
        default=False,
        description=(
            "Whether Waiting for Trigger stays set during an inspection, so that the status does "
            "not tell of a trigger that is taken. A status comes after every change (SC manual "
            "p. 29, published), and this bit says that the camera waits (off: published). A client "
            "is told of it by `shows_triggers=no` in the URL."
        ),
    )
    bad_frame: Literal["skip", "close"] = Field(
        default="skip",
        description=(
            "TCP: after a wrong magic number or an impossible length, skip to the next magic "
            "number or close the connection. Invalid messages are ignored (SC manual p. 28, "
            "published); how a stream goes on is unknown (skip: recommended)."
        ),
    )
    second_client: Literal["takeover", "refuse"] = Field(
        default="takeover",
        description=(
            "TCP: a Connect while another client has the session takes the session over, or the "
            "newcomer's connection is closed without an answer. On UDP the newcomer wins (SC "
            "manual p. 28, published), whatever stands here; on TCP unknown (takeover: inferred)."
        ),
    )
    overtriggered_time: Seconds = Field(
        default=0.1,
        description=(
            "How long Overtriggered stays set after the last dropped trigger. It falls by itself "
            "(SC manual p. 30, published); the duration is unknown (0.1: recommended)."
        ),
    )
    input_queue_depth: int = Field(
        default=8,
        ge=1,
        le=1024,
        description=(
            "Input containers that are kept. They are queued, and one more drops one (SC manual "
            "p. 30, published); the depth is unknown, and so is which one is dropped (8, the "
            "oldest: recommended)."
        ),
    )
    reboot_time: Seconds = Field(
        default=30.0,
        description=(
            "How long a reboot keeps the camera off the network: about 30 s (mvBlueGEMINI manual "
            "p. 31, published for a related camera)."
        ),
    )
    code: bool = Field(
        default=False,
        description=(
            "b16: answers begin with a result code, as those of BVS ID do. What BVS SC answers in "
            "this dialect is open (off: as in the 32-bit dialects, but 16-bit numbers; inferred)."
        ),
    )
    no_id: bool = Field(
        default=False,
        description=(
            "b16: result containers do not begin with the program's id. The newest SC manual's "
            "table and two other documents have the id, its example on p. 43 has none (off: the "
            "example is probably an old one, inferred)."
        ),
    )
    big_endian_number: bool = Field(
        default=False,
        description=(
            "b16: the number of Set sequence number is big endian, as the bytes of the example in "
            "the newest SC manual, p. 48, are; the manual's general rule is little endian (off: "
            "the example is probably a misprint, inferred)."
        ),
    )
    disconnect_answer: Literal["code", "silent"] = Field(
        default="code",
        description=(
            "bid: whether a Disconnect is answered. The German BVS ID guide p. 58 shows an answer, "
            "the English one p. 227 none, both published (code: every request is answered, p. 52)."
        ),
    )
    bad_message: Literal["code", "ignore"] = Field(
        default="code",
        description=(
            "bid: unknown ids are answered with 0x13 and wrong lengths with 0x10 (BVS ID guide "
            "p. 52, published), or ignored (p. 206, published) (code: recommended)."
        ),
    )
    push_status: bool = Field(
        default=False,
        description=(
            'bid: the option "Send status information automatically": a status with every change '
            "(BVS ID guide p. 210, published); off, it comes on request only. Its default on the "
            "device is unknown (off: recommended)."
        ),
    )

    @property
    def of_the_wire(self) -> list[str]:
        """Names of the dialect's deviations that are on."""
        return [name for name in ("code", "no_id", "big_endian_number") if getattr(self, name)]
