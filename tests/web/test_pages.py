"""Pages are put together of what all have and of files of their own."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from smartcam.web._pages import PAGES, page_html
from tests import ROOT

FOLDER = ROOT / "smartcam" / "web" / "page"
VOID = {"meta", "link", "input", "br", "img", "hr"}


class _Balance(HTMLParser):
    """Keeps the elements that are open, and the ids that came."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.ids += [value for name, value in attrs if name == "id" and value]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_every_page_has_a_row() -> None:
    files = {path.stem for path in FOLDER.glob("*.html")}
    assert files == {*PAGES, "head", "top"}


@pytest.mark.parametrize("name", PAGES)
def test_page_is_whole_and_names_files_that_are_there(name: str) -> None:
    html = page_html(name)
    balance = _Balance()
    balance.feed(html)
    balance.close()
    assert balance.open == []
    assert len(balance.ids) == len(set(balance.ids))
    assert {"gate", "token", "gate-error", "main"} <= set(balance.ids)
    assert f"<title>smartcam {PAGES[name].title}</title>" in html
    assert not re.search(r"\$\w", html)
    named = re.findall(r'(?:href|src)="/([^"]+)"', html)
    assert all((FOLDER / one).is_file() for one in named)
    assert f"{name}.js" in named
