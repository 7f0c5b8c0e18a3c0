"""The journal: what is written is there, what is broken or in use is refused."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from smartcam.calibration.wizards import journal as module
from smartcam.calibration.wizards.journal import MAX_LINE, Journal
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from pathlib import Path


def test_entries_are_read_again_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    with Journal(path) as journal:
        assert (journal.header, journal.entries) == (None, [])
        journal.start({"wizard": "w"})
        assert journal.append({"at": (1, 0.1)}) == {"at": [1, 0.1]}
    with Journal(path) as journal:
        assert (journal.header, journal.entries) == ({"wizard": "w"}, [{"at": [1, 0.1]}])
        journal.append({"n": 2})
    assert path.read_text() == '{"wizard":"w"}\n{"at":[1,0.1]}\n{"n":2}\n'


@pytest.mark.parametrize(
    ("body", "text"),
    [(b"{}\nhello\n{}\n", "line 2 is no JSON"), (b"{}\n[1]\n", "line 2 is no object")],
)
def test_journal_that_is_broken_within_is_refused(tmp_path: Path, body: bytes, text: str) -> None:
    path = tmp_path / "a.journal"
    path.write_bytes(body)
    with pytest.raises(CalibrationError, match=text) as caught:
        Journal(path)
    assert caught.value.code == "BROKEN_FILE"
    assert path.read_bytes() == body


def test_journal_in_use_is_refused_until_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    with Journal(path), pytest.raises(CalibrationError, match="another sequence writes it"):
        Journal(path)
    Journal(path).close()


@pytest.mark.parametrize(
    ("value", "text"),
    [(float("nan"), "cannot be stored"), ("x" * MAX_LINE, "expected 1048576 at most")],
)
def test_entry_that_cannot_be_kept_is_refused(tmp_path: Path, value: object, text: str) -> None:
    with Journal(tmp_path / "a.journal") as journal:
        journal.start({})
        with pytest.raises(CalibrationError, match=text) as caught:
            journal.append({"value": value})
        assert caught.value.code == "NOT_STORABLE"
    assert (tmp_path / "a.journal").read_text() == "{}\n"


def test_journal_takes_no_more_than_its_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_ENTRIES", 2)
    with Journal(tmp_path / "a.journal") as journal:
        journal.start({})
        for number in range(2):
            journal.append({"n": number})
        with pytest.raises(CalibrationError, match="entry 3, expected 2 at most"):
            journal.append({"n": 2})


def test_journal_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.journal").symlink_to(tmp_path / "made")
    with pytest.raises(OSError, match="symbolic links"):
        Journal(tmp_path / "a.journal")
    assert not (tmp_path / "made").exists()
