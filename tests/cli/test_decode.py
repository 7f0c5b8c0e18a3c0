"""``smartcam decode``: frames and containers, without a camera."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from tests.cli.commandline import (
    ACTIVE_21,
    BUSY,
    CONNECT,
    CONNECTED,
    HELLO_WORLD,
    QUERY,
    SWITCH_5,
    SWITCHED_5,
    WAITING,
    each,
    run,
    thesis,
)

RESULT_3 = bytes.fromhex(
    "50535642 19000000 20000000 03000000 ff 02000000 0000cb42 000050c0 4142430000000000"
)
LAYOUT_3 = "passed: bool, count: int32, x: real32, y: real32, code: string[8]"
VALUE_3 = {"passed": True, "count": 2, "x": 101.5, "y": -3.25, "code": "ABC"}


FRAMES: list[tuple[bytes, str, str, dict[str, int]]] = [
    (CONNECT, "client", "Connect", {}),
    (CONNECTED, "camera", "ConnectAnswer", {"version": 1}),
    (WAITING, "camera", "StatusReport", {"status": 0x280, "endian": 0}),
    (BUSY, "camera", "StatusReport", {"status": 0x10, "endian": 0}),
    (QUERY, "client", "Query", {}),
    (ACTIVE_21, "camera", "QueryAnswer", {"application": 21}),
    (SWITCH_5, "client", "SwitchApplication", {"application": 5}),
    (SWITCHED_5, "camera", "SwitchAnswer", {"code": 0, "application": 5}),
]


def test_decode_frame_json_has_every_field() -> None:
    for frame, sender, message, body in FRAMES:
        for dialect, data in (("handbook", frame), ("thesis", thesis(frame))):
            with each(dialect, message):
                check_frame(frame, sender, message, body, dialect, data)


def check_frame(
    frame: bytes, sender: str, message: str, body: dict[str, int], dialect: str, data: bytes
) -> None:
    (line,) = run("decode", data.hex(), "--json").done().lines
    assert (line["offset"], line["dialect"]) == (0, dialect)
    assert (line["sender"], line["message"]) == (sender, message)
    assert line["message_id"] == frame[8]
    fields = {field["name"]: field for field in line["fields"]}
    assert list(fields) == ["magic", "length", "message_id", *body]
    assert {name: fields[name]["value"] for name in body} == body
    assert bytes.fromhex("".join(field["raw"] for field in line["fields"])) == data


def test_decode_frame_for_people_shows_offsets_and_values() -> None:
    lines = run("decode", SWITCHED_5.hex(" ")).done().out.splitlines()
    assert lines[0] == "at 0: SwitchAnswer from the camera, dialect handbook"
    assert lines[1].split() == ["offset", "field", "bytes", "value"]
    assert lines[-1].split() == ["16", "application", "05", "00", "00", "00", "5"]


def test_decode_several_frames_from_a_hex_file(tmp_path: Path) -> None:
    path = tmp_path / "frames.txt"
    path.write_text(f"{CONNECTED.hex(' ')}\n{WAITING.hex(' ')}\n", encoding="ascii")
    lines = run("decode", str(path), "--json").done().lines
    assert [line["message"] for line in lines] == ["ConnectAnswer", "StatusReport"]
    assert [line["offset"] for line in lines] == [0, len(CONNECTED)]


def test_decode_several_frames_from_a_binary_file(tmp_path: Path) -> None:
    path = tmp_path / "frames.bin"
    path.write_bytes(CONNECT + HELLO_WORLD)
    lines = run("decode", str(path), "--interpret-as", "text: string[20]", "--json").done().lines
    assert [line["message"] for line in lines] == ["Connect", "ResultContainer"]
    assert lines[1]["value"] == {"text": "Hello World"}


@pytest.mark.parametrize("data", [QUERY, QUERY.hex().encode(), QUERY.hex(" ").encode() + b"\n"])
def test_decode_standard_input(data: bytes) -> None:
    (line,) = run("decode", "-", "--json", stdin=data).done().lines
    assert line["message"] == "Query"


def test_decode_result_frame_with_layout_shows_the_value() -> None:
    outcome = run("decode", RESULT_3.hex(), "--interpret-as", LAYOUT_3)
    assert outcome.done().out.splitlines()[-2:] == ["  y = -3.25", "  code = ABC"]


def test_decode_unknown_message_shows_its_payload() -> None:
    (line,) = run("decode", "50535642 02000000 77000000 abcd", "--json").done().lines
    assert (line["message"], line["message_id"]) == ("UnknownMessage", 0x77)
    assert line["fields"][-1]["raw"] == "abcd"


def test_decode_container_with_layout_gives_the_value() -> None:
    data = RESULT_3[16:].hex()
    (line,) = run("decode", data, "--interpret-as", LAYOUT_3, "--json").done().lines
    assert line == {"value": VALUE_3}


def test_decode_container_big_endian_turns_the_numbers() -> None:
    data = struct.pack(">if", 2, 101.5).hex()
    spec = ("--interpret-as", "count: int32, x: real32")
    assert run("decode", data, *spec, "--big-endian", "--json").done().lines == [
        {"value": {"count": 2, "x": 101.5}}
    ]
    assert run("decode", data, *spec, "--json").done().lines != [
        {"value": {"count": 2, "x": 101.5}}
    ]


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ("localizations", "(nothing)"),
        ("raw", "00 00"),
        ("strings50", "  \n"),
        ("table: (x: real32 mm)*", "  x [m]\n      0\n"),
    ],
)
def test_decode_container_of_zeros_for_people(spec: str, text: str) -> None:
    size = {"localizations": 70, "strings50": 50}.get(spec, 4)
    assert text in run("decode", "00" * size, "--interpret-as", spec).done().out


@pytest.mark.parametrize("data", ["garbage", "0", "abc", "x" * 5000, "no/such/file"])
def test_decode_neither_hex_nor_file_exits_2(data: str) -> None:
    run("decode", data).failed(2, "decode: ", data[:60])


def test_decode_empty_exits_2() -> None:
    run("decode", "").failed(2, "no bytes")
    run("decode", "-", stdin=b"").failed(2, "no bytes")


def test_decode_container_without_layout_exits_2() -> None:
    run("decode", "01020304").failed(2, "01 02 03 04 begins no frame", "--interpret-as")


def test_decode_wrong_layout_exits_2() -> None:
    run("decode", "01020304", "--interpret-as", "n: int33").failed(2, "at character 3")


@pytest.mark.parametrize("size", [13, 35])
def test_decode_cut_frame_exits_3(size: int) -> None:
    outcome = run("decode", HELLO_WORLD[:size].hex())
    outcome.failed(3, f"the last {size} bytes, from offset 0, are no whole frame")


def test_decode_cut_second_frame_shows_the_first_and_exits_3() -> None:
    outcome = run("decode", (CONNECT + WAITING[:-1]).hex(), "--json")
    outcome.failed(3, "the last 19 bytes, from offset 12, are no whole frame")
    assert [line["message"] for line in outcome.lines] == ["Connect"]


def test_decode_garbage_after_a_frame_exits_3() -> None:
    run("decode", (CONNECT + b"garbage").hex()).failed(3, "wrong magic number")


def test_decode_short_body_exits_3_in_one_line() -> None:
    run("decode", "50535642 04000000 12000000 05000000").failed(
        3, "StatusReport (0x12) came with 4 bytes"
    )


def test_decode_short_container_exits_6() -> None:
    outcome = run("decode", "0100", "--interpret-as", "n: int32")
    outcome.failed(6, "'n' (int32) at offset 0: expected 4 bytes, got 2")


def test_decode_short_container_in_a_frame_exits_6() -> None:
    run("decode", HELLO_WORLD.hex(), "--interpret-as", "n: int32, s: string[20]").failed(6, "'s'")


def test_decode_frames_without_a_magic_number_by_their_dialect() -> None:
    outcome = run("decode", "31 00 04 00 1A 00 01 00", "--dialect", "bid", "--json")
    (shown,) = outcome.lines
    assert (shown["message"], shown["dialect"], shown["sender"]) == (
        "SwitchAnswer",
        "bid",
        "camera",
    )
    assert [(f["name"], f["value"]) for f in shown["fields"][2:]] == [
        ("code", 0x1A),
        ("application", 1),
    ]


def test_decode_frames_of_a_dialect_with_a_quirk() -> None:
    outcome = run("decode", "0100040000000100", "--dialect", "b16", "--quirks", "code")
    assert "ConnectAnswer from the camera, dialect b16 with quirk code" in outcome.out


def test_decode_quirks_without_a_dialect_is_wrong_usage() -> None:
    run("decode", "00", "--quirks", "code").failed(2, "name it with --dialect")


_FIRST, _SECOND = WAITING[:16], WAITING[16:]
DUMPS = {
    "blanks": WAITING.hex(" "),
    "colons": WAITING.hex(":"),
    "hyphens": WAITING.hex("-"),
    "numbers of C": "{" + ", ".join(f"0x{one:02x}" for one in WAITING) + "};",
    "escapes": '"' + "".join(f"\\x{one:02X}" for one in WAITING) + '"',
    "Wireshark": f"0000   {_FIRST.hex(' ')}\n0010   {_SECOND.hex(' ')}\n",
    "Wireshark with text": f"0000   {_FIRST.hex(' ')}   PSVB............\n"
    f"0010   {_SECOND.hex(' ')}                                       ab cd\n",
    "text that is not aligned": f"0000   {_FIRST.hex(' ')}   PSVB............\n"
    f"0010   {_SECOND.hex(' ')}   ....\n",
    "xxd": f"00000000: {_FIRST.hex(' ', 2)}  PSVB............\n"
    f"00000010: {_SECOND.hex(' ', 2)}                                ab cd\n",
    "hexdump -C": f"00000000  {_FIRST[:8].hex(' ')}  {_FIRST[8:].hex(' ')}  |PSVB....|ab|\n"
    f"00000010  {_SECOND.hex(' ')}                                       |abcd|\n00000014\n",
    "tcpdump -X": f"\t0x0000:  {_FIRST.hex(' ', 2)}  PSVB............\n"
    f"\t0x0010:  {_SECOND.hex(' ', 2)}                                ab cd\n",
    "one line": f"0000   {WAITING.hex(' ')}   PSVB",
}


@pytest.mark.parametrize("name", DUMPS)
def test_decode_bytes_as_tools_copy_them(tmp_path: Path, name: str) -> None:
    path = tmp_path / "bytes.txt"
    path.write_text(DUMPS[name])
    (line,) = run("decode", str(path), "--json").done().lines
    assert line["message"] == "StatusReport"


def test_decode_dump_with_a_gap_says_which_line(tmp_path: Path) -> None:
    path = tmp_path / "bytes.txt"
    path.write_text(DUMPS["Wireshark"].replace("0010", "0020"))
    run("decode", str(path)).failed(2, "line 2 has offset 0x20: expected 0x10")


@pytest.mark.parametrize(("data", "value"), [("0000 0200", 0x20000), ("0000   02 00 00 00", 2)])
def test_decode_four_digits_are_an_offset_where_more_blanks_follow(data: str, value: int) -> None:
    (line,) = run("decode", data, "--interpret-as", "n: int32", "--json").done().lines
    assert line["value"] == {"n": value}


@pytest.mark.parametrize("data", ["0000   zz", "50:5", "0x5", "\\x5", "50 5"])
def test_decode_bytes_that_are_not_whole_say_what_is_expected(data: str) -> None:
    run("decode", data).failed(2, "or a dump with offsets")
