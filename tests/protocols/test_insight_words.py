"""Words of native mode: cells, numbers, checksums, lines, answers; vectors from public pages."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError, FrameError
from smartcam.protocols._inside import StatusCode, words
from smartcam.protocols._line_reader import LineReader
from tests.protocols.inside import (
    MAX_IMAGE_BYTES,
    AnswerForm,
    AnswerReader,
    Cell,
    CommandAnswer,
    hex_lines,
)
from tests.protocols.insight_lines import BITMAP, DIGITS, IMAGE_LINES, crc

# ---------------------------------------------------------------------- cells


@pytest.mark.parametrize(
    ("text", "cell", "wire"),
    [
        ("A1", Cell("A", 1), "A001"),
        ("b12", Cell("B", 12), "B012"),
        ("Z399", Cell("Z", 399), "Z399"),
        ("c007", Cell("C", 7), "C007"),
    ],
)
def test_parse_cell_reads_what_people_write(text: str, cell: Cell, wire: str) -> None:
    assert words.parse_cell(text) == cell
    assert cell.wire == wire
    assert words.parse_cell(str(cell)) == cell


@pytest.mark.parametrize("text", ["", "A", "1", "A400", "AA1", "A-1", "A1 ", "Ä1", "A1:B2", "A1x"])
def test_parse_cell_of_anything_else_names_the_bounds(text: str) -> None:
    with pytest.raises(ConfigurationError, match="expected a column A to Z and a row 0 to 399"):
        words.parse_cell(text)


def test_parse_cells_goes_row_by_row() -> None:
    assert [str(cell) for cell in words.parse_cells("B2:D3")] == [
        "B2", "C2", "D2", "B3", "C3", "D3",
    ]  # fmt: skip
    assert words.parse_cells("a5") == [Cell("A", 5)]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("D2:B3", "the second cell lies left of the first, or above it"),
        ("B3:B2", "the second cell lies left of the first, or above it"),
        ("A0:Z399", "'A0:Z399' has 10400 cells, more than 1024"),
        ("A1:", "'' is no cell"),
    ],
)
def test_parse_cells_of_no_rectangle_raises(text: str, error: str) -> None:
    with pytest.raises(ConfigurationError, match=error):
        words.parse_cells(text)


def test_parse_wire_cell_takes_three_digits_and_leaves_the_rest() -> None:
    assert words.parse_wire_cell("A0028") == (Cell("A", 2), "8")  # published: SIA0028
    assert words.parse_wire_cell("b002After SS") == (Cell("B", 2), "After SS")
    assert words.parse_wire_cell("A02") is None
    assert words.parse_wire_cell("A400") is None


def test_parse_tag_takes_names_and_forgets_their_case() -> None:
    assert words.parse_tag("Math_1.A1") == "math_1.a1"  # published
    assert words.parse_tag("x" * 127) == "x" * 127


@pytest.mark.parametrize("text", ["", "1st", "B22222", "two words", "x" * 128, "näh", "x\n"])
def test_parse_tag_of_anything_else_raises(text: str) -> None:
    with pytest.raises(ConfigurationError, match="is no name of a cell"):
        words.parse_tag(text)


@given(st.sampled_from("ABCXYZ"), st.integers(0, 399))
def test_a_cell_survives_the_wire(column: str, row: int) -> None:
    cell = Cell(column, row)
    assert words.parse_wire_cell(cell.wire + " rest") == (cell, " rest")


# ---------------------------------------------------------------------- jobs, codes, data


@pytest.mark.parametrize(
    ("file", "number"),
    [("85Test.job", 85), ("0.job", 0), ("007x.job", 7), ("1234.job", None), ("Test85.job", None)],
)
def test_job_id_is_the_number_before_the_name(file: str, number: int | None) -> None:
    assert words.job_id(file) == number


def test_code_text_depends_on_the_command() -> None:
    assert words.code_text("lf5bolts.job", -2) == (
        "the camera is online, there is no such job, or it failed to load"
    )
    assert words.code_text("SW8", -2) == "not possible, or the camera is offline"
    assert words.code_text("XX", 0) == "the camera does not know the command"
    assert words.code_text("GO", -7) == "a code that is not documented for this command"


def test_every_documented_code_has_a_name() -> None:
    codes = {code for row in words.COMMANDS.values() for code in row.codes}
    assert codes <= {int(code) for code in StatusCode}
    assert all(words.COMMANDS[name].mnemonic == name for name in words.COMMANDS)


def test_checksum_is_of_the_digits() -> None:
    assert words.checksum(b"123456789") == "31C3"  # the check value of CRC-16/XMODEM
    assert words.checksum(b"") == "0000"


@pytest.mark.parametrize(
    ("data", "digits", "lines"),
    [
        (b"", 0, b"0000\r\n"),
        # published: the characters ABCDEF01 are what counts; checksums by CognexNativePy 1.0.12
        (b"\xab\xcd\xef\x01", 8, b"ABCDEF01\r\n6EA1\r\n"),
        (bytes(40), 80, b"0" * 80 + b"\r\n" + b"A587\r\n"),
        (bytes(41), 82, b"0" * 80 + b"\r\n" + b"00\r\n" + b"3022\r\n"),
    ],
)
def test_hex_lines_have_eighty_digits_and_a_checksum(
    data: bytes, digits: int, lines: bytes
) -> None:
    assert words.hex_lines(data) == (digits, lines)


# ---------------------------------------------------------------------- lines


def camera_reader(max_line: int = words.MAX_LINE_BYTES) -> LineReader:
    return LineReader(words.ENDS, max_line=max_line, encoding=words.ENCODING)


def lines_of(reader: LineReader) -> list[str]:
    found = []
    while (line := reader.next_line()) is not None:
        found.append(line)
    return found


@given(st.lists(st.binary(max_size=5)), st.booleans())
def test_lines_do_not_depend_on_how_bytes_arrive(chunks: list[bytes], nul: bool) -> None:
    alphabet = bytes.maketrans(bytes(range(256)), (b"a\r\n\x00" * 64))
    chunks = [chunk.translate(alphabet) for chunk in chunks]
    make = words.command_reader if nul else camera_reader
    whole, parts = make(), make()
    whole.feed(b"".join(chunks))
    found = []
    for chunk in chunks:
        parts.feed(chunk)
        found += lines_of(parts)
    assert found == lines_of(whole)
    assert len(parts) == len(whole)


def test_reader_of_the_camera_takes_nul_as_an_end() -> None:
    reader = words.command_reader()
    reader.feed(b"GO\r\nGJ\x00GF\r\x00\xb0\r\nrest")
    assert lines_of(reader) == ["GO", "GJ", "GF", "\xb0"]
    assert len(reader) == 4


def test_reader_of_the_client_keeps_nul_and_single_ends() -> None:
    reader = camera_reader()
    reader.feed(b"a\x00b\rc\nd\r\n")
    assert lines_of(reader) == ["a\x00b\rc\nd"]


def test_line_of_the_greatest_length_passes_and_a_longer_one_raises() -> None:
    reader = camera_reader(max_line=4)
    reader.feed(b"1234\r")
    assert reader.next_line() is None
    reader.feed(b"\n12345\r\n")
    assert reader.next_line() == "1234"
    with pytest.raises(FrameError, match="a line of more than 4 bytes came") as caught:
        reader.next_line()
    assert caught.value.data == b"12345\r\n"


def test_line_without_an_end_raises_when_it_is_too_long() -> None:
    reader = camera_reader(max_line=4)
    reader.feed(b"123456")
    with pytest.raises(FrameError, match="a line of more than 4 bytes came"):
        reader.next_line()


def test_prompts_and_counted_bytes_are_taken_between_lines() -> None:
    reader = camera_reader()
    reader.feed(b"Welcome\r\nUse")
    assert reader.next_line() == "Welcome"
    assert not reader.take_prompt(words.USER_PROMPT)
    reader.feed(b"r: <a>\r\n</a>\r\n")
    assert reader.take_prompt(words.USER_PROMPT)
    assert reader.take(9) == b"<a>\r\n</a>"
    assert reader.take(3) is None
    assert reader.next_line() == ""


# ---------------------------------------------------------------------- answers


FORMS = [
    (AnswerForm.CODE, b"1\r\n", CommandAnswer(1)),
    (AnswerForm.CODE, b" -2 \r\n", CommandAnswer(-2)),
    (AnswerForm.BARE, b"\xb0 x\r\n", CommandAnswer(1, "\xb0 x")),
    (AnswerForm.LINE, b"1\r\n 12.500 \r\n", CommandAnswer(1, " 12.500 ")),
    (AnswerForm.LINE, b"1\r\n\r\n", CommandAnswer(1, "")),
    (AnswerForm.LINE, b"-1\r\n", CommandAnswer(-1)),
    (AnswerForm.INFO, b"1\r\na\r\nb\r\nc\r\nd\r\ne\r\n", CommandAnswer(1, "a\nb\nc\nd\ne")),
    (AnswerForm.SIZED, b"1\r\n0\r\n\r\n", CommandAnswer(1, "")),
    (AnswerForm.SIZED, b"1\r\n4\r\na\r\nb\r\n", CommandAnswer(1, "a\r\nb")),
    (AnswerForm.HEX, b"1\r\n100\r\n" + IMAGE_LINES, CommandAnswer(1, data=BITMAP)),
    (AnswerForm.HEX, b"1\r\n50\r\n" + IMAGE_LINES.lower(), CommandAnswer(1, data=BITMAP)),
    (AnswerForm.HEX, b"-6\r\n", CommandAnswer(-6)),
]
each = pytest.mark.parametrize(("form", "heard", "answer"), FORMS)


class Pieces:
    """A reader and the pieces that it told of."""

    def __init__(self, max_length: int = 100) -> None:
        self.told: list[tuple[str, bool]] = []
        self.reader = AnswerReader(max_length=max_length, on_pieces=self._take)

    def _take(self, pieces: Sequence[bytes], ended: bool) -> None:
        self.told += [(piece.decode("latin-1"), ended) for piece in pieces]


@each
def test_answer_is_read_at_every_split_point(
    form: AnswerForm, heard: bytes, answer: CommandAnswer
) -> None:
    for split in range(len(heard)):
        pieces = Pieces()
        pieces.reader.expect(form)
        pieces.reader.feed(heard[:split])
        assert pieces.reader.next_answer() is None
        pieces.reader.feed(heard[split:])
        assert pieces.reader.next_answer() == answer
        assert len(pieces.reader) == 0


@each
def test_answer_is_told_in_pieces_with_their_ends(
    form: AnswerForm, heard: bytes, answer: CommandAnswer
) -> None:
    pieces = Pieces()
    pieces.reader.expect(form)
    pieces.reader.feed(heard)
    pieces.reader.next_answer()
    assert "".join(text + "\r\n" * ended for text, ended in pieces.told).encode("latin-1") == heard


@each
def test_answer_leaves_what_stands_behind_it(
    form: AnswerForm, heard: bytes, answer: CommandAnswer
) -> None:
    reader = Pieces().reader
    reader.expect(form)
    reader.feed(heard + b"next\r\n")
    assert reader.next_answer() == answer
    assert reader.next_answer() is None
    assert reader.next_line() == "next"


def test_answer_that_nothing_expects_is_none() -> None:
    reader = Pieces().reader
    reader.feed(b"1\r\n")
    assert reader.next_answer() is None


def test_prompt_is_taken_whole_only() -> None:
    pieces = Pieces()
    pieces.reader.feed(b"User:")
    assert not pieces.reader.take_prompt(b"User: ")
    pieces.reader.feed(b" ")
    assert pieces.reader.take_prompt(b"User: ")
    assert pieces.told == [("User: ", False)]


def test_sized_text_longer_than_accepted_is_refused_before_it_comes() -> None:
    reader = Pieces(max_length=7).reader
    reader.expect(AnswerForm.SIZED)
    reader.feed(b"1\r\n8\r\n")
    with pytest.raises(FrameError, match="a text of 8 bytes comes; 0 to 7 are accepted"):
        reader.next_answer()


def test_image_larger_than_accepted_is_refused_at_its_header() -> None:
    reader = Pieces().reader
    reader.expect(AnswerForm.HEX)
    header = (b"BM" + struct.pack("<I", MAX_IMAGE_BYTES + 1)).hex().encode()
    reader.feed(b"1\r\n1\r\n" + header + b"\r\n")
    with pytest.raises(FrameError, match=f"a bitmap of {MAX_IMAGE_BYTES + 1} bytes comes; at most"):
        reader.next_answer()


def test_image_in_lines_of_a_byte_is_read() -> None:
    reader = Pieces().reader
    reader.expect(AnswerForm.HEX)
    lines = b"".join(DIGITS[at : at + 2] + b"\r\n" for at in range(0, len(DIGITS), 2))
    reader.feed(b"1\r\n100\r\n" + lines + crc(DIGITS) + b"\r\n")
    answer = reader.next_answer()
    assert answer is not None
    assert answer.data == BITMAP


@example([b"4D4", b"4D4"], 0, [])
@example([b"0aFf", b"", b"0aFf"], 0, [])
@example([b"0aFf", b"0aFf", b"42"], 1, [41, 500])
@given(
    st.lists(
        st.sampled_from([b"42", b"4D4", b"", b"0aFf", b"4 4D", b"\xff\xff", b"4\n", b"00" * 40])
    ),
    st.integers(0, 60),
    st.lists(st.integers(0, 400), max_size=6),
)
def test_image_is_the_same_in_pieces_of_any_size_broken_or_not(
    lines: list[bytes], missing: int, cuts: list[int]
) -> None:
    size = 6 + max(0, sum(map(len, lines)) // 2 - missing)
    start = b"1\r\n1\r\n" + (b"BM" + struct.pack("<I", size)).hex().encode() + b"\r\n"
    heard = start + b"".join(line + b"\r\n" for line in lines) + b"0000\r\n"
    read = []
    for splits in (range(len(heard)), cuts, ()):  # byte by byte there are never two lines at once
        points = sorted({0, len(heard), *(cut for cut in splits if cut < len(heard))})
        pieces, answer, failed = Pieces(), None, ""
        pieces.reader.expect(AnswerForm.HEX)
        for begin, end in pairwise(points):
            pieces.reader.feed(heard[begin:end])
            try:
                answer = answer or pieces.reader.next_answer()
            except FrameError as exc:
                failed = str(exc)
                break
        read.append((answer, failed, pieces.told))
    assert read[0] == read[1] == read[2]


def test_image_with_a_broken_line_behind_thousands_is_told_up_to_it() -> None:
    pieces = Pieces()
    pieces.reader.expect(AnswerForm.HEX)
    header = (b"BM" + struct.pack("<I", 1 << 20)).hex().encode()
    pieces.reader.feed(b"1\r\n1\r\n" + header + b"\r\n" + b"00\r\n" * 5000 + b"0x\r\n00\r\n")
    with pytest.raises(FrameError, match="'0x' came, hexadecimal digits of an image were due"):
        pieces.reader.next_answer()
    assert pieces.told[-2:] == [("00", True), ("0x", True)]
    assert len(pieces.told) == 3 + 5000 + 1


def test_image_with_a_line_too_long_among_others_is_refused() -> None:
    reader = Pieces().reader
    reader.expect(AnswerForm.HEX)
    header = (b"BM" + struct.pack("<I", 1 << 20)).hex().encode()
    lines = [
        b"1",
        b"1",
        header,
        b"00",
        b"00" * (words.MAX_LINE_BYTES // 2),
        b"0" * (words.MAX_LINE_BYTES + 2),
    ]
    reader.feed(b"".join(line + b"\r\n" for line in lines))
    with pytest.raises(FrameError, match=f"a line of more than {words.MAX_LINE_BYTES} bytes came"):
        reader.next_answer()


@given(st.binary(min_size=1, max_size=500), st.booleans())
def test_image_of_the_camera_is_read_back(body: bytes, in_bytes: bool) -> None:
    data = b"BM" + struct.pack("<I", len(body) + 6) + body
    digits, lines = hex_lines(data)
    reader = Pieces().reader
    reader.expect(AnswerForm.HEX)
    reader.feed(b"1\r\n%d\r\n" % (len(data) if in_bytes else digits) + lines)
    assert reader.next_answer() == CommandAnswer(1, data=data)
    assert lines.endswith(crc(data.hex().upper().encode()) + b"\r\n")


@given(st.sampled_from(list(AnswerForm)), st.binary(max_size=200), st.booleans())
def test_any_bytes_are_an_answer_or_a_frame_error(
    form: AnswerForm,
    heard: bytes,
    done: bool,
) -> None:
    reader = Pieces().reader
    reader.expect(form)
    reader.feed(b"1\r\n" * done + heard)
    try:
        answer = reader.next_answer()
    except FrameError:
        return
    assert answer is None or isinstance(answer, CommandAnswer)
