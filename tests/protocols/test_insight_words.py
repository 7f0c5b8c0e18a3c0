"""Words of native mode: cells, job numbers, checksums, lines; vectors from the public pages."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError, FrameError
from smartcam.protocols.insight import words
from smartcam.protocols.insight.words import Cell, LineReader, StatusCode

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


def lines_of(reader: LineReader) -> list[str]:
    found = []
    while (line := reader.next_line()) is not None:
        found.append(line)
    return found


@given(st.lists(st.binary(max_size=5)), st.booleans())
def test_lines_do_not_depend_on_how_bytes_arrive(chunks: list[bytes], nul: bool) -> None:
    alphabet = bytes.maketrans(bytes(range(256)), (b"a\r\n\x00" * 64))
    chunks = [chunk.translate(alphabet) for chunk in chunks]
    whole, parts = LineReader(nul_ends=nul), LineReader(nul_ends=nul)
    whole.feed(b"".join(chunks))
    found = []
    for chunk in chunks:
        parts.feed(chunk)
        found += lines_of(parts)
    assert found == lines_of(whole)
    assert len(parts) == len(whole)


def test_reader_of_the_camera_takes_nul_as_an_end() -> None:
    reader = LineReader(nul_ends=True)
    reader.feed(b"GO\r\nGJ\x00GF\r\x00\xb0\r\nrest")
    assert lines_of(reader) == ["GO", "GJ", "GF", "\xb0"]
    assert len(reader) == 4


def test_reader_of_the_client_keeps_nul_and_single_ends() -> None:
    reader = LineReader()
    reader.feed(b"a\x00b\rc\nd\r\n")
    assert lines_of(reader) == ["a\x00b\rc\nd"]


def test_line_of_the_greatest_length_passes_and_a_longer_one_raises() -> None:
    reader = LineReader(max_line=4)
    reader.feed(b"1234\r")
    assert reader.next_line() is None
    reader.feed(b"\n12345\r\n")
    assert reader.next_line() == "1234"
    with pytest.raises(FrameError, match="a line of more than 4 bytes came") as caught:
        reader.next_line()
    assert caught.value.data == b"12345\r\n"


def test_line_without_an_end_raises_when_it_is_too_long() -> None:
    reader = LineReader(max_line=4)
    reader.feed(b"123456")
    with pytest.raises(FrameError, match="a line of more than 4 bytes came"):
        reader.next_line()


def test_prompts_and_counted_bytes_are_taken_between_lines() -> None:
    reader = LineReader()
    reader.feed(b"Welcome\r\nUse")
    assert reader.next_line() == "Welcome"
    assert not reader.take_prompt(words.USER_PROMPT)
    reader.feed(b"r: <a>\r\n</a>\r\n")
    assert reader.take_prompt(words.USER_PROMPT)
    assert reader.take(9) == b"<a>\r\n</a>"
    assert reader.take(3) is None
    assert reader.next_line() == ""
