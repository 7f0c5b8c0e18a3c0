"""Answers of In-Sight native mode: each form, in pieces, and with sizes that are not true."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from insight_lines import BITMAP, DIGITS, IMAGE_LINES, crc

from smartcam.exceptions import FrameError
from smartcam.protocols.insight.answers import MAX_IMAGE, Answer, AnswerReader
from smartcam.protocols.insight.words import AnswerForm, hex_lines

FORMS = [
    (AnswerForm.CODE, b"1\r\n", Answer(1)),
    (AnswerForm.CODE, b" -2 \r\n", Answer(-2)),
    (AnswerForm.BARE, b"\xb0 x\r\n", Answer(1, "\xb0 x")),
    (AnswerForm.LINE, b"1\r\n 12.500 \r\n", Answer(1, " 12.500 ")),
    (AnswerForm.LINE, b"1\r\n\r\n", Answer(1, "")),
    (AnswerForm.LINE, b"-1\r\n", Answer(-1)),
    (AnswerForm.INFO, b"1\r\na\r\nb\r\nc\r\nd\r\ne\r\n", Answer(1, "a\nb\nc\nd\ne")),
    (AnswerForm.SIZED, b"1\r\n0\r\n\r\n", Answer(1, "")),
    (AnswerForm.SIZED, b"1\r\n4\r\na\r\nb\r\n", Answer(1, "a\r\nb")),
    (AnswerForm.HEX, b"1\r\n100\r\n" + IMAGE_LINES, Answer(1, data=BITMAP)),
    (AnswerForm.HEX, b"1\r\n50\r\n" + IMAGE_LINES.lower(), Answer(1, data=BITMAP)),
    (AnswerForm.HEX, b"-6\r\n", Answer(-6)),
]
each = pytest.mark.parametrize(("form", "heard", "answer"), FORMS)


class Pieces:
    """A reader and the pieces that it told of."""

    def __init__(self, max_length: int = 100) -> None:
        self.told: list[tuple[str, bool]] = []
        self.reader = AnswerReader(max_length=max_length, on_piece=self._take)

    def _take(self, text: str, ended: bool) -> None:
        self.told.append((text, ended))


@each
def test_answer_is_read_at_every_split_point(
    form: AnswerForm, heard: bytes, answer: Answer
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
    form: AnswerForm, heard: bytes, answer: Answer
) -> None:
    pieces = Pieces()
    pieces.reader.expect(form)
    pieces.reader.feed(heard)
    pieces.reader.next_answer()
    assert "".join(text + "\r\n" * ended for text, ended in pieces.told).encode("latin-1") == heard


@each
def test_answer_leaves_what_stands_behind_it(
    form: AnswerForm, heard: bytes, answer: Answer
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
    header = (b"BM" + struct.pack("<I", MAX_IMAGE + 1)).hex().encode()
    reader.feed(b"1\r\n1\r\n" + header + b"\r\n")
    with pytest.raises(FrameError, match=f"a bitmap of {MAX_IMAGE + 1} bytes comes; at most"):
        reader.next_answer()


def test_image_in_lines_of_a_byte_is_read() -> None:
    reader = Pieces().reader
    reader.expect(AnswerForm.HEX)
    lines = b"".join(DIGITS[at : at + 2] + b"\r\n" for at in range(0, len(DIGITS), 2))
    reader.feed(b"1\r\n100\r\n" + lines + crc(DIGITS) + b"\r\n")
    answer = reader.next_answer()
    assert answer is not None
    assert answer.data == BITMAP


@given(st.binary(min_size=1, max_size=500), st.booleans())
def test_image_of_the_camera_is_read_back(body: bytes, in_bytes: bool) -> None:
    data = b"BM" + struct.pack("<I", len(body) + 6) + body
    digits, lines = hex_lines(data)
    reader = Pieces().reader
    reader.expect(AnswerForm.HEX)
    reader.feed(b"1\r\n%d\r\n" % (len(data) if in_bytes else digits) + lines)
    assert reader.next_answer() == Answer(1, data=data)
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
    assert answer is None or isinstance(answer, Answer)
