"""Put the pages of the sites together: a common head and top, and each page's own file."""

from __future__ import annotations

import importlib.resources
from string import Template
from typing import Final, NamedTuple


class Page(NamedTuple):
    """The contents of a page's head.

    Attributes:
        title: title of the page.
        command: the command that prints the page's address, as HTML; empty for a page that has its
            own top.
        styles: names of the style sheets before its own.
        beside: HTML that is shown next to the title.
        does: verb in the page's sentence "everything it does (or shows) is an HTTP call, too".
    """

    title: str
    command: str = ""
    styles: tuple[str, ...] = ("base",)
    beside: str = '<p id="name"></p>'
    does: str = "does"


PAGES: Final = {
    "cloud": Page("cloud", "<code>smartcam depth show</code>"),
    "colours": Page("colours", "<code>smartcam frames colours</code>"),
    "emulator": Page(
        "emulator",
        "<code>smartcam-emulator</code>",
        beside='<nav id="cameras" aria-label="Cameras"></nav>',
    ),
    "fleet": Page("fleet", "<code>smartcam fleet page</code>", does="shows"),
    "frames": Page("frames", "<code>smartcam frames</code>", ("base", "pictures")),
    "live": Page(
        "live",
        '<code id="gate-served">smartcam live</code>',
        ("base", "pictures"),
        '<a id="back" href="/" hidden>All cameras</a>\n    <p id="name"></p>',
    ),
    "teach": Page("teach", "<code>smartcam teach</code>"),
    "wizard": Page("calibration", styles=()),
}
"""The pages, by the name of their files."""


def read_file(name: str) -> bytes:
    """Return the bytes of a file of ``smartcam/web/page``."""
    return importlib.resources.files("smartcam.web").joinpath("page", name).read_bytes()


def page_html(name: str) -> str:
    """Return the HTML of a page: the common head and top, then its own file."""
    page = PAGES[name]
    sheets = [f'  <link rel="stylesheet" href="/{sheet}.css">' for sheet in (*page.styles, name)]
    values = page._asdict() | {"styles": "\n".join(sheets), "script": name}
    parts = ("head.html", "top.html") if page.command else ("head.html",)
    common = [Template(read_file(part).decode()).substitute(values) for part in parts]
    return "".join((*common, "\n" if page.command else "", read_file(f"{name}.html").decode()))
