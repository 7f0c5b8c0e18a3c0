"""Shapes as SVG and PDF: to scale, filled, always the same bytes."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET

import pytest

from smartcam.calibration.printing.page import Disc, Page, Polygon, Text, pdf, rectangle, svg

SHAPES = (
    rectangle(10, 20, 30, 5),
    Disc((50.0, 60.0), 2.5),
    Text((10, 90), "a <b> (c) \\", 2.6),
    Text((5, 10), "up", 3, turned=True),
)
PAGE = Page(100, 120.5, "A & B", json.dumps({"kind": "<none>"}), SHAPES)
SVG = "{http://www.w3.org/2000/svg}"


def test_svg_is_as_large_as_the_page_in_millimetres() -> None:
    root = ET.fromstring(svg(PAGE).encode())  # noqa: S314
    assert (root.get("width"), root.get("height")) == ("100mm", "120.5mm")
    assert root.get("viewBox") == "0 0 100 120.5"


def test_svg_turns_y_up_into_y_down() -> None:
    text = svg(PAGE)
    assert "M10 100.5 40 100.5 40 95.5 10 95.5Z" in text
    assert "M47.5 60.5A2.5 2.5 0 0 0 52.5 60.5A2.5 2.5 0 0 0 47.5 60.5Z" in text
    assert '<text x="5" y="110.5" font-size="3" transform="rotate(-90 5 110.5)">up</text>' in text


def test_svg_has_no_stroke_and_carries_title_and_description() -> None:
    root = ET.fromstring(svg(PAGE).encode())  # noqa: S314
    assert "stroke" not in svg(PAGE)
    assert root.findtext(f"{SVG}title") == "A & B"
    assert root.findtext(f"{SVG}metadata") == '{"kind": "<none>"}'
    assert [one.text for one in root.iter(f"{SVG}text")] == ["a <b> (c) \\", "up"]


def test_pdf_is_as_large_as_the_page_in_points() -> None:
    assert b"/MediaBox [0 0 283.4646 341.5748]" in pdf(PAGE)
    assert b"2.834645669 0 0 2.834645669 0 0 cm\n10 20 m 40 20 l 40 25 l 10 25 l h" in pdf(PAGE)


def test_pdf_finds_its_objects_by_their_offsets() -> None:
    data = pdf(PAGE)
    start = int(data.rsplit(b"startxref\n", 1)[1].split()[0])
    assert data[start:].startswith(b"xref\n0 7\n")
    offsets = [int(one) for one in re.findall(rb"(\d{10}) 00000 n \n", data[start:])]
    assert [data[at:].split(b" obj")[0] for at in offsets] == [b"%d 0" % n for n in range(1, 7)]


def test_pdf_content_is_as_long_as_it_says() -> None:
    data = pdf(PAGE)
    (length,) = re.findall(rb"/Length (\d+)", data)
    content = data.split(b"stream\n", 1)[1]
    assert content[int(length) :].startswith(b"\nendstream")


def test_pdf_asks_for_its_own_size_and_strokes_nothing() -> None:
    data = pdf(PAGE)
    assert b"/ViewerPreferences << /PrintScaling /None >>" in data
    content = data.split(b"stream\n", 1)[1].split(b"\nendstream")[0].decode()
    assert not re.search(r"(^|\s)[sSbB]\*?($|\n)", re.sub(r"\(.*\)", "", content))
    assert b"(a <b> \\(c\\) \\\\) Tj" in data


@pytest.mark.parametrize("write", [svg, pdf])
def test_document_of_the_same_page_is_the_same(write: object) -> None:
    assert callable(write)
    assert write(PAGE) == write(Page(100, 120.5, "A & B", PAGE.description, tuple(SHAPES)))


def test_length_is_written_to_a_tenth_of_a_micrometre() -> None:
    page = Page(10, 10, "", "", (Polygon(((1 / 3, -1e-9), (2, 3), (4.5, 6))),))
    assert b"0.3333 0 m 2 3 l 4.5 6 l h" in pdf(page)
