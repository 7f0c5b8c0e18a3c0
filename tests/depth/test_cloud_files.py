"""Clouds as files: bytes by hand, files of other programs, and files that are no clouds."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from smartcam.depth import Cloud, load_cloud, save_cloud
from smartcam.depth import _cloud_files as files_module
from smartcam.depth._pcd import unpack_lzf
from smartcam.depth._tables import BadFileError
from smartcam.exceptions import ConfigurationError, FrameFormatError, FrameSourceError

CLOUD = Cloud(
    np.array([[1.5, -2, 0.1], [0, 4, -8.25]]),
    np.array([[255, 128, 1], [0, 2, 3]], np.uint8),
    np.array([0.5, 0.001]),
)

PLY_HEAD = """\
ply
format {} 1.0
comment unit m
element vertex 2
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property float sigma
end_header
"""
PLY_BYTES = PLY_HEAD.format("binary_little_endian").encode() + bytes.fromhex(
    "0000c03f 000000c0 cdcccc3d ff8001 0000003f"  # 1.5, -2, 0.1; 255, 128, 1; 0.5
    "00000000 00008040 000004c1 000203 6f12833a"  # 0, 4, -8.25; 0, 2, 3; 0.001
)
PLY_TEXT = PLY_HEAD.format("ascii").encode() + (
    b"1.5 -2 0.100000001 255 128 1 0.5\n0 4 -8.25 0 2 3 0.00100000005\n"
)
PCD_HEAD = """\
# unit m
VERSION 0.7
FIELDS x y z rgb sigma
SIZE 4 4 4 4 4
TYPE F F F {} F
COUNT 1 1 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA {}
"""
PCD_BYTES = PCD_HEAD.format("F", "binary").encode() + bytes.fromhex(
    "0000c03f 000000c0 cdcccc3d 0180ff00 0000003f"  # the colour is 0x00rrggbb
    "00000000 00008040 000004c1 03020000 6f12833a"
)
PCD_TEXT = PCD_HEAD.format("U", "ascii").encode() + (
    b"1.5 -2 0.100000001 16744449 0.5\n0 4 -8.25 515 0.00100000005\n"
)
GOLDEN = [
    ("a.ply", False, PLY_BYTES),
    ("a.PLY", True, PLY_TEXT),
    ("a.pcd", False, PCD_BYTES),
    ("a.pcd", True, PCD_TEXT),
]


def same(one: Cloud, other: Cloud) -> bool:
    return all(
        (a is None) == (b is None) and (a is None or np.array_equal(a, b))
        for a, b in zip(one.__reduce__()[1], other.__reduce__()[1], strict=True)
    )


def loaded(folder: Path, name: str, data: bytes) -> Cloud:
    path = folder / name
    path.write_bytes(data)
    return load_cloud(path, unit="m")


@pytest.mark.parametrize(("name", "text", "data"), GOLDEN)
def test_files_match_the_formats_documents(
    tmp_path: Path, name: str, text: bool, data: bytes
) -> None:
    save_cloud(tmp_path / name, CLOUD, text=text)
    assert (tmp_path / name).read_bytes() == data
    assert same(load_cloud(tmp_path / name), CLOUD)
    save_cloud(str(tmp_path / name), Cloud(CLOUD.points), text=text)
    assert same(load_cloud(str(tmp_path / name)), Cloud(CLOUD.points))
    save_cloud(tmp_path / name, Cloud(np.empty((0, 3))), text=text)
    assert len(load_cloud(tmp_path / name)) == 0
    assert [one.name for one in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("text", [False, True])
def test_every_float_comes_back(tmp_path: Path, suffix: str, text: bool) -> None:
    rng = np.random.default_rng(3)
    bits = rng.integers(0, 2**32, (9_000, 3), dtype=np.uint32)
    points = bits.view(np.float32)
    points = points[np.isfinite(points).all(axis=1)][:8_000]
    colours = rng.integers(0, 256, points.shape, dtype=np.uint8)
    cloud = Cloud(points, colours, rng.random(len(points)))
    path = tmp_path / f"a{suffix}"
    save_cloud(path, cloud, text=text)
    assert same(load_cloud(path), cloud)


def test_ply_as_others_write_it(tmp_path: Path) -> None:
    head = (
        b"ply\r\nformat binary_big_endian 1.0\r\ncomment caf\xe9\r\nobj_info 3\r\n"
        b"element camera 2\r\nproperty int id\r\nelement vertex 2\r\n"
        b"property float64 x\r\nproperty float nx\r\nproperty double y\r\nproperty float32 z\r\n"
        b"property uint8 red\r\nproperty uchar green\r\nproperty uchar blue\r\n"
        b"property uchar alpha\r\nelement face 1\r\nproperty list uchar int vertex_indices\r\n"
        b"end_header\r\n"
    )
    row = struct.Struct(">dfdfBBBB")
    rows = row.pack(1, 9, 2, 3, 4, 5, 6, 7) + row.pack(0.25, 9, -2, -3, 40, 50, 60, 70)
    data = head + bytes(8) + rows + bytes([3]) + bytes(12)
    cloud = loaded(tmp_path, "a.ply", data)
    assert cloud.points.tolist() == [[1, 2, 3], [0.25, -2, -3]]
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[4, 5, 6], [40, 50, 60]]
    text = (
        b"ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nelement vertex 2\n"
        b"property float red\nproperty float green\nproperty float blue\n"
        b"property float x\nproperty float y\nproperty float z\nend_header\n"
        b"3 0 1 2\n0 0.5 1 1 2 3\n\n1 1 1 nan 2 3"  # the last is no point
    )
    cloud = loaded(tmp_path, "b.ply", text)
    assert cloud.points.tolist() == [[1, 2, 3]]
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[0, 128, 255]]


@pytest.mark.parametrize(
    ("kinds", "form", "values"),
    [
        ("uchar", "B", (255, 128, 0)),
        ("ushort", "H", (65535, 32896, 0)),
        ("float", "f", (255.0, 128.0, 0.0)),
        ("double", "d", (1.0, 128 / 255, 0.0)),
        ("int", "i", (255, 128, 0)),
    ],
)
@pytest.mark.parametrize(
    "names", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"]
)
def test_colours_as_others_name_and_size_them(
    tmp_path: Path, names: str, kinds: str, form: str, values: tuple[float, ...]
) -> None:
    colours = "".join(f"property {kinds} {name}\n" for name in names.split())
    lists = "element camera 2\nproperty short id\nproperty list ushort int of\n"
    place = "property float x\nproperty float y\nproperty float z\n"
    begin = "ply\nformat binary_little_endian 1.0\n"
    head = f"{begin}{lists}element vertex 1\n{place}{colours}end_header\n"
    cameras = struct.pack("<hH2ihH", 1, 2, 7, 8, 2, 0)
    data = head.encode() + cameras + struct.pack(f"<3f3{form}", 1, 2, 3, *values)
    cloud = loaded(tmp_path, "a.ply", data)
    assert cloud.points.tolist() == [[1, 2, 3]]
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[255, 128, 0]]
    for wrong, said in (
        (
            data[: len(head) + 2] + b"\xff\xff" + data[len(head) + 4 :],
            "2 rows for camera, got fewer",
        ),
        (data.replace(b"camera 2", b"camera 2000000"), "1048576 rows of lists"),
        (data.replace(b"list ushort", b"list float"), "a whole number as their size"),
    ):
        with pytest.raises(FrameFormatError, match=said):
            loaded(tmp_path, "a.ply", wrong)


def test_colours_of_a_pcd_may_be_fields_of_their_own(tmp_path: Path) -> None:
    head = (
        b"VERSION 0.7\nFIELDS x y z r g b\nSIZE 4 4 4 1 1 1\nTYPE F F F U U U\n"
        b"COUNT 1 1 1 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA binary\n"
    )
    cloud = loaded(tmp_path, "a.pcd", head + struct.pack("<3f3B", 1, 2, 3, 255, 128, 0))
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[255, 128, 0]]


def test_organised_pcd_with_padding_and_normals(tmp_path: Path) -> None:
    head = (
        b"# .PCD v.7\nVERSION .7\nFIELDS x y z _ normal rgba\nSIZE 8 8 8 1 4 4\nTYPE F F F U F U\n"
        b"COUNT 1 1 1 4 3 1\nWIDTH 2\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA "
    )
    row = struct.Struct("<ddd4s3fI")
    rows = [row.pack(n, n or float("nan"), 2, b"----", 0, 0, 1, 0xFF010203) for n in range(4)]
    cloud = loaded(tmp_path, "a.pcd", head + b"binary\n" + b"".join(rows))
    assert cloud.points.tolist() == [[n, n, 2] for n in (1, 2, 3)]
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[1, 2, 3]] * 3
    lines = b"".join(b"%d 1 2 0 0 0 0 0 0 1 66051\n" % n for n in range(4))
    assert loaded(tmp_path, "b.pcd", head + b"ascii\n" + lines).points[:, 0].tolist() == [
        0,
        1,
        2,
        3,
    ]


def test_compressed_pcd(tmp_path: Path) -> None:
    # columns: x 1 and 1, y 0 and 0, z 0 and 0: "00 00 80 3f" as it is, then the same from 4 back,
    # then a zero, then 15 bytes from 1 back
    packed = bytes.fromhex("03 0000803f 40 03 00 00 e0 06 00")
    body = bytes.fromhex("0000803f" * 2) + bytes(16)
    assert unpack_lzf(packed, 24) == body
    head = PCD_HEAD.format("F", "binary_compressed").replace(" rgb sigma", "")
    for line in ("SIZE", "TYPE", "COUNT"):
        start = head.index(line)
        words = head[start:].split("\n", 1)[0].split()
        head = head.replace(" ".join(words), " ".join(words[:4]))
    data = head.encode() + struct.pack("<II", len(packed), 24) + packed
    assert loaded(tmp_path, "a.pcd", data).points.tolist() == [[1, 0, 0], [1, 0, 0]]
    for wrong in (data[:-1], data[:-14], data.replace(b"\x18\0\0\0", b"\xff\xff\xff\xff")):
        with pytest.raises(FrameFormatError):
            loaded(tmp_path, "a.pcd", wrong)
    with pytest.raises(BadFileError, match="4 bytes before it"):
        unpack_lzf(bytes.fromhex("20 03"), 3)


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("a.ply", b"ply\n", b"pli\n", "a PLY file, which begins with ply"),
        ("a.ply", b"vertex 2", b"vertex 3", "expected 3 rows of 19 bytes, 57 in all, got 38"),
        ("a.ply", b"vertex 2", b"vertex 999999999999999", "999999999999999 rows"),
        ("a.ply", b"vertex 2", b"vertex -2", "a number of rows, got '-2'"),
        ("a.ply", b"element vertex", b"element point", "an element vertex, got 'point'"),
        ("a.ply", b"float z", b"float w", "x, y and z, got no z"),
        ("a.ply", b"float z", b"float x", "each once"),
        ("a.ply", b"float z", b"quad z", "a line of a PLY header, got 'property quad z'"),
        ("a.ply", b"float z", b"list uchar int z", "rows of numbers for vertex"),
        ("a.ply", b"uchar red", b"char red", "colours of 0 to 1, of 0 to 255 or of 16"),
        ("a.ply", b"little_endian 1.0", b"little_endian 2.0", "PLY header"),
        ("a.ply", b"end_header\n", b"", "PLY header|header"),
        ("a.ply", b"\x6f\x12\x83\x3a", b"\x6f\x12\x83\xba", "a cloud, got sigma"),
        ("t.ply", b"4 -8.25", b"4", "7 numbers in row 2 of the data"),
        ("t.ply", b"4 -8.25", b"4 -8.25 7", "7 numbers in row 2 of the data"),
        ("t.ply", b"4 -8.25", b"4 x", "expected numbers, got"),
        ("t.ply", b"255", b"256", "numbers from 0 to 255"),
        ("t.ply", b"255", b"1e2", "expected numbers"),
        ("t.ply", b"vertex 2", b"vertex 4", "4 lines of"),
        ("a.pcd", b"VERSION 0.7", b"VERSION 0.5", "VERSION 0.7, got '0.5'"),
        ("a.pcd", b"FIELDS x", b"FIELD x", "a PCD file's"),
        ("a.pcd", b"WIDTH 2", b"WIDTH 3", "POINTS equal to WIDTH times HEIGHT, got 2, 3 and 1"),
        ("a.pcd", b"WIDTH 2\nHEIGHT 1", b"WIDTH 2\nHEIGHT 9999", "POINTS"),
        ("a.pcd", b"SIZE 4", b"SIZE 3", "got 'F3'"),
        ("a.pcd", b"COUNT 1", b"COUNT 0", "COUNT from 1"),
        ("a.pcd", b"COUNT 1", b"COUNT 99", "rows|2 rows"),
        ("a.pcd", b"COUNT 1", b"COUNT 2", "x, y and z|rows"),
        ("a.pcd", b"DATA binary", b"DATA zip", "DATA ascii, binary"),
        ("a.pcd", b"x y z", b"x y y", "each of the FIELDS once"),
        ("a.pcd", b"TYPE F F", b"TYPE F", "with SIZE, TYPE and COUNT of each"),
    ],
)
def test_wrong_files_are_refused(
    tmp_path: Path, name: str, old: bytes, new: bytes, said: str
) -> None:
    data = {"a.ply": PLY_BYTES, "t.ply": PLY_TEXT, "a.pcd": PCD_BYTES}[name]
    assert old in data
    with pytest.raises(FrameFormatError, match=said) as caught:
        loaded(tmp_path, name, data.replace(old, new, 1))
    assert caught.value.source == str(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name))


def test_coordinates_too_far_for_float32_are_refused(tmp_path: Path) -> None:
    head = PLY_HEAD.format("ascii").replace("float x", "double x").encode()
    rows = b"%s 0 0 1 2 3 0\n0 0 0 1 2 3 0\n"
    with pytest.raises(FrameFormatError, match=r"x up to 4\.5e"):
        loaded(tmp_path, "a.ply", head + rows % b"4500000.1")
    assert len(loaded(tmp_path, "a.ply", head + rows % b"4500.1")) == 2


def test_files_that_cannot_be_had(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigurationError, match=r"ends in .ply or .pcd"):
        load_cloud(tmp_path / "a.stl")
    with pytest.raises(FrameSourceError, match="cannot be read: No such file"):
        load_cloud(tmp_path / "a.ply")
    with pytest.raises(ConfigurationError, match="cannot be written: No such file"):
        save_cloud(tmp_path / "no" / "a.ply", CLOUD)
    monkeypatch.setattr(files_module, "MAX_FILE_BYTES", 100)
    with pytest.raises(FrameFormatError, match="100 bytes at most"):
        loaded(tmp_path, "a.ply", PLY_BYTES)


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(b"old")

    def full(_handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(ConfigurationError, match="No space left"):
        save_cloud(path, CLOUD)
    assert path.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["a.ply"]


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_torn_and_mixed_files_are_clouds_or_typed_errors(
    tmp_path: Path, data: st.DataObject
) -> None:
    name, _, whole = data.draw(st.sampled_from(GOLDEN))
    body = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(body) - 1))
        change = data.draw(st.sampled_from(["byte", "cut", "insert", "double"]))
        if change == "byte":
            body[place] = data.draw(st.integers(0, 255))
        elif change == "cut":
            del body[place : place + data.draw(st.integers(1, 30))]
        elif change == "insert":
            body[place:place] = data.draw(st.binary(min_size=1, max_size=8))
        else:
            body[place:place] = body[place : place + 30]
        if not body:
            break
    with contextlib.suppress(FrameFormatError):
        loaded(tmp_path, name, bytes(body))


@given(st.binary(max_size=64), st.integers(0, 4096))
def test_any_bytes_unpack_or_are_refused(data: bytes, size: int) -> None:
    with contextlib.suppress(BadFileError):
        assert len(unpack_lzf(data, size)) == size


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.ply", PLY_TEXT.replace(b"comment unit m\n", b"")),
        ("a.pcd", PCD_BYTES.replace(b"# unit m\n", b"# .PCD v0.7\n")),
        (
            "scan.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty short x\nproperty short y\n"
            b"property short z\nend_header\n120 -35 842\n",
        ),
    ],
)
def test_cloud_that_does_not_say_its_unit_is_asked_for_it(
    tmp_path: Path, name: str, data: bytes
) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FrameFormatError, match=r'expected a unit, .* give unit="m" or unit="mm"'):
        load_cloud(tmp_path / name)
    metres, millimetres = (load_cloud(tmp_path / name, unit=unit) for unit in ("m", "mm"))
    np.testing.assert_allclose(1000 * millimetres.points, metres.points, rtol=1e-6)
    if metres.sigma is not None and millimetres.sigma is not None:
        np.testing.assert_allclose(1000 * millimetres.sigma, metres.sigma, rtol=1e-6)


def test_cloud_of_millimetres_says_so_in_a_comment(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(PLY_TEXT.replace(b"unit m\n", b"unit mm\n"))
    np.testing.assert_allclose(load_cloud(tmp_path / "a.ply").points, CLOUD.points / 1000)


def test_cloud_in_a_unit_of_no_name_is_refused(tmp_path: Path) -> None:
    unit: Any = "furlong"
    with pytest.raises(ConfigurationError, match="expected one of m, cm, mm, inch, got 'furlong'"):
        load_cloud(tmp_path / "a.ply", unit=unit)
