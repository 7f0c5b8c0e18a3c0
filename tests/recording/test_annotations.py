"""Marks on recorded pictures: Foxglove's own classes read them, and so does smartcam again."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from smartcam.frames import Frame
from smartcam.inspection import Drawing
from smartcam.recording import Recorder, load_recording
from tests.recording.picturekit import shot

MARKS = (
    Drawing("polygon", ((-0.5, -0.5), (10.25, 0.0), (10.0, 20.0)), "region"),
    Drawing("line", ((1.0, 2.0), (3.0, 4.0)), "wrong", "7.31 mm"),
    Drawing("text", ((0.0, 22.0),), "found", "café: ok"),
    Drawing("points", ((5.0, 6.0), (7.5, 8.5)), "hint"),
)

numbers = st.floats(-1e6, 1e6)
drawings = st.builds(
    Drawing,
    st.sampled_from(["points", "line", "polygon"]),
    st.lists(st.tuples(numbers, numbers), min_size=1, max_size=20).map(tuple),
    st.sampled_from(["found", "wrong", "region", "hint"]),
    st.text(max_size=120).filter(lambda text: text.isprintable()),
)


def recorded(path: Path, *pictures: Frame) -> Path:
    with Recorder(path, overwrite=True) as recorder:
        for picture in pictures:
            assert recorder.add_picture(picture)
    return path


def near(found: tuple[Drawing, ...], written: tuple[Drawing, ...]) -> bool:
    """Return True if marks are the same, places to a millionth of a pixel."""
    return len(found) == len(written) and all(
        (one.kind, one.role, one.text) == (other.kind, other.role, other.text)
        and len(one.points) == len(other.points)
        and all(map(lambda a, b: math.dist(a, b) < 1e-6, one.points, other.points))
        for one, other in zip(found, written, strict=True)
    )


def message_class(name: str) -> Any:
    module = f"foxglove_schemas_protobuf.{name}_pb2"
    return getattr(pytest.importorskip(module, reason="needs the extra dev"), name)


def is_repeated(field: Any) -> bool:
    """Return True if a message may have several of a field."""
    found = getattr(field, "is_repeated", None)
    return field.label == field.LABEL_REPEATED if found is None else bool(found)


def test_foxgloves_own_classes_read_the_marks(tmp_path: Path) -> None:
    kind = message_class("ImageAnnotations")
    path = recorded(tmp_path / "run.mcap", shot(1, drawings=MARKS))
    with path.open("rb") as stream:
        (_, channel, message), (_, _, picture) = make_reader(stream).iter_messages()
    assert (channel.topic, message.log_time) == ("/left/annotations", picture.log_time)
    found = kind.FromString(message.data)
    types = [one.type for one in found.points]
    points = message_class("PointsAnnotation")
    assert types == [points.LINE_LOOP, points.LINE_STRIP, points.POINTS]
    first, second, _ = found.points
    # Foxglove counts from the corner of the first pixel, smartcam from its centre
    assert [(one.x, one.y) for one in first.points] == [(0.0, 0.0), (10.75, 0.5), (10.5, 20.5)]
    assert (first.outline_color.b, first.outline_color.a) == (217 / 255, 1.0)
    assert first.thickness == 1.0
    texts = [(one.text, one.position.x, one.position.y) for one in found.texts]
    assert texts == [("7.31 mm", 1.5, 2.5), ("café: ok", 0.5, 22.5)]
    assert abs(second.timestamp.seconds + second.timestamp.nanos / 1e9 - shot(1).utc) < 1e-6


def test_schema_in_the_file_is_foxgloves(tmp_path: Path) -> None:
    descriptors = pytest.importorskip(
        "google.protobuf.descriptor_pb2", reason="needs the extra dev"
    )
    path = recorded(tmp_path / "run.mcap", shot(1, drawings=MARKS))
    with path.open("rb") as stream:
        ((schema, _, _), _) = make_reader(stream).iter_messages()
    assert schema is not None
    described = descriptors.FileDescriptorSet.FromString(schema.data).file[-1]
    for message in described.message_type:
        theirs = {one.name: one for one in message_class(message.name).DESCRIPTOR.fields}
        for field in message.field:
            if field.number > 100:
                assert field.name not in theirs
                continue
            other = theirs[field.name]
            of = other.message_type or other.enum_type
            name = "" if of is None else f".{of.full_name}"
            repeated = field.label == field.LABEL_REPEATED
            said = field.number, field.type, field.type_name, repeated
            assert said == (other.number, other.type, name, is_repeated(other))
    (types,) = (one.enum_type[0] for one in described.message_type if one.enum_type)
    values = message_class("PointsAnnotation").Type.items()
    assert [(one.name, one.number) for one in types.value] == values


def test_marks_are_read_by_the_schema_in_their_file(tmp_path: Path) -> None:
    decoder = pytest.importorskip("mcap_protobuf.decoder", reason="needs the extra dev")
    path = recorded(tmp_path / "run.mcap", shot(1, drawings=MARKS), shot(2, "MJPEG"))
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[decoder.DecoderFactory()])
        marks, first, second = (message for *_, message in reader.iter_decoded_messages())
    assert [one.role for one in marks.points] == ["region", "wrong", "hint"]
    assert (first.sequence, first.annotations_number, second.annotations_number) == (1, 1, 0)


@given(st.lists(drawings, max_size=8).map(tuple))
def test_marks_are_read_as_they_were_recorded(
    tmp_path_factory: pytest.TempPathFactory, marks: tuple[Drawing, ...]
) -> None:
    path = tmp_path_factory.getbasetemp() / "marks.mcap"
    recording = load_recording(recorded(path, shot(1), shot(2, drawings=marks), shot(3)))
    assert (recording.counts.pictures, recording.remark) == (3, "")
    before, marked, after = recording.pictures()
    assert near(marked.drawings, marks)
    assert before.drawings == after.drawings == ()
    assert bytes(marked.data) == bytes(shot(2).data)


def test_each_picture_has_its_own_marks(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        for number in range(20):
            marks = () if number % 3 == 0 else (Drawing("text", ((1, 2),), "found", f"n{number}"),)
            recorder.add_picture(shot(number, drawings=marks), camera="ab"[number % 2])
    found = [*load_recording(tmp_path / "run.mcap").pictures()]
    texts = {one.sequence: [mark.text for mark in one.drawings] for one in found}
    assert texts == {n: [] if n % 3 == 0 else [f"n{n}"] for n in range(20)}


def test_marks_that_nobody_could_draw_are_left_out(tmp_path: Path) -> None:
    nowhere = Drawing("line", ((1.0, math.nan), (2.0, 3.0)))
    marks = (nowhere, Drawing("polygon", ()), MARKS[0], *(MARKS[1] for _ in range(2000)))
    (found,) = load_recording(recorded(tmp_path / "run.mcap", shot(1, drawings=marks))).pictures()
    assert near(found.drawings, (MARKS[0], *(MARKS[1] for _ in range(997))))


@given(st.data())
def test_damaged_marks_end_a_recording_or_are_others(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.mcap"
    whole = bytearray(recorded(path, shot(1, drawings=MARKS)).read_bytes())
    begin, end = whole.index(b"region"), whole.index(b"hint")
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(begin - 120, end + 40))] = data.draw(st.integers(0, 255))
    place = 8
    while whole[place] != 6:  # records before the chunk
        place += 9 + struct.unpack_from("<Q", whole, place + 1)[0]
    whole[place + 33 : place + 37] = bytes(4)  # the chunk's checksum: there is none
    path.write_bytes(whole)
    recording = load_recording(path)
    assert recording.remark or recording.counts.pictures == 1
    assert all(isinstance(one, Drawing) for frame in recording.pictures() for one in frame.drawings)


def test_picture_whose_marks_were_taken_out_of_the_file_has_none(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", shot(1, drawings=MARKS))
    data = path.read_bytes().replace(b"foxglove.ImageAnnotations", b"foxglove.ImageAnnotationz")
    path.write_bytes(data)
    recording = load_recording(path)
    assert recording.counts.pictures in (0, 1)
    assert all(one.drawings == () for one in recording.pictures())
