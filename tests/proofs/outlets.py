"""Prove that outlets lose nothing unseen and double nothing: thousands of lives that are cut off.

A cell is a cameras' process with an outlet that lives several times, and a far end. Each life ends
well, or is killed: at a line of smartcam's code, at a byte that it writes, at any moment. The far
end (a journal in a process of its own, or the store of results) is killed, stalls and cuts the line
at any moment, too. The disk is full for a while, the clock is set, the spool is damaged or deleted
between two lives. Then one life delivers what is left, and the judge compares what the far end has
with what was offered.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import random
import select
import signal
import socket
import sqlite3
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from tests.proofs.outlet_lives import LIFE_SECONDS, Life, keep_journal, live, value_of

KINDS = ("line", "byte", "moment", "full disk", "full spool", "memory", "clock", "damage")
"""The faults of cells; the far end dies, stalls and cuts the line in each of them."""


# ---------------------------------------------------------------------- plans


@dataclass
class Cell:
    """A cell, as its number and the seed say."""

    number: int
    kind: str
    journal: bool
    away: bool  # the far end comes with the last life
    lives: list[Life]
    moments: list[tuple[int, float] | None]  # offers, and seconds behind, when a life is killed
    damages: bool
    dice: random.Random


def plan(seed: int, number: int) -> Cell:
    """Return the plan of a cell."""
    dice = random.Random(f"{seed} {number}")  # noqa: S311
    kind = KINDS[number % len(KINDS)]
    lives, moments = list[Life](), list[tuple[int, float] | None]()
    room, policy = 1 << 30, dice.choice(["drop_oldest", "drop_newest"])
    if kind == "full spool":
        room = dice.randrange(2_000, 20_000)
    for _ in range(dice.randrange(1, 4)):
        clock = (0.0, 0.0)
        if kind == "clock":
            clock = (dice.uniform(-1e8, 1e8), dice.uniform(-1e8, 1e8))
        ends = kind if kind in ("line", "byte", "moment") else dice.choice(["line", "moment", ""])
        life = Life(
            offers=dice.randrange(5, 60),
            line=int(10 ** dice.uniform(0.5, 4.0)) if ends == "line" else 0,
            open_first=dice.random() < 0.7,
            byte=int(10 ** dice.uniform(4.5, 6.0)) if ends == "byte" else 0,
            full=int(10 ** dice.uniform(3.0, 5.3)) if kind == "full disk" else 0,
            clock=clock,
            waiting=dice.randrange(3, 12) if kind == "memory" else 20_000,
            room=room,
            policy=policy,
            gather=dice.choice([0.0, 0.0, 0.001, 0.01]),
            seed=dice.randrange(1 << 30),
        )
        lives.append(life)
        moment = dice.randrange(life.offers), dice.choice([0.0, dice.uniform(0, 0.004)])
        moments.append(moment if ends == "moment" else None)
    lives.append(Life(offers=dice.randrange(0, 5), drains=True, room=room, policy=policy))
    moments.append(None)
    journal = dice.random() < 0.7
    away = dice.random() < (0.7 if kind == "full spool" else 0.2)
    return Cell(number, kind, journal, away, lives, moments, kind == "damage", dice)


# ---------------------------------------------------------------------- processes


@dataclass
class Lived:
    """Report of a life.

    Attributes:
        offers: cameras of the results that were offered, in order.
        epoch: epoch of its ids; 0 where it did not come so far.
        before, kept: results in the account on the disk at the beginning, and at last.
        account: account at the end; None where it was killed.
        code: number of the signal that ended it; 0 where it ended by itself.
        disturbed: whether the spool was damaged behind this life.
    """

    offers: list[str] = field(default_factory=list[str])
    epoch: int = 0
    before: int = 0
    kept: int = 0
    account: dict[str, Any] | None = None
    code: int = 0
    disturbed: bool = False

    def hear(self, text: str) -> None:
        """Take what a life said."""
        word, *said = text.split(" ", 2)
        if word == "epoch":
            self.epoch, self.before = int(said[0]), int(said[1])
            self.kept = self.before
        elif word == "kept":
            self.kept = int(said[0])
        elif word == "offer":
            self.offers.append(said[1])
        else:
            self.account = json.loads(" ".join(said))


def forked(work: Callable[[], int]) -> int:
    """Return the number of a process that does something and ends."""
    sys.stdout.flush()
    process = os.fork()
    if process:
        return process
    code = 70
    try:
        code = work()
    except BaseException:  # noqa: BLE001 - the parent sees the code
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


class FarEnd:
    """The journal's process, which is started again whenever it has died."""

    def __init__(self, cell: Cell, folder: Path) -> None:
        self._cell, self._path = cell, folder / "journal"
        self.deaths = 0
        self._process = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]

    def look(self, *, faults: bool = True) -> None:
        """Start it where it is dead."""
        if self._process:
            ended, _ = os.waitpid(self._process, os.WNOHANG)
            if not ended:
                return
            self.deaths += 1
        seed, listener, path = self._cell.dice.randrange(1 << 30), self._listener, self._path

        def keep() -> int:
            keep_journal(listener, path, seed, faults)
            return 0

        self._process = forked(keep)

    def stop(self) -> None:
        """End it."""
        if self._process:
            os.kill(self._process, signal.SIGKILL)
            os.waitpid(self._process, 0)
            self._process = 0

    def close(self) -> None:
        """End it for good."""
        self.stop()
        self._listener.close()


def lived(number: int, cell: Cell, section: dict[str, Any], folder: Path, far: FarEnd) -> Lived:
    """Have a life lived; return what it said."""
    life, moment, told = cell.lives[number], cell.moments[number], Lived()
    reading, writing = os.pipe()

    def work() -> int:
        os.close(reading)
        return live(number, life, section, folder, writing)

    process = forked(work)
    os.close(writing)
    begun, rest = time.monotonic(), b""
    kill_at = 0.0
    while True:
        if cell.journal and (life.drains or not cell.away):
            far.look(faults=not life.drains)
        if select.select([reading], [], [], 0.002)[0]:
            data = os.read(reading, 1 << 16)
            if not data:
                break
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                told.hear(line.decode())
        now = time.monotonic()
        if moment is not None and len(told.offers) > moment[0] and not kill_at:
            kill_at = now + moment[1]
        if (kill_at and now > kill_at) or now - begun > LIFE_SECONDS + 30:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
    os.close(reading)
    _, status = os.waitpid(process, 0)
    told.code = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    if os.WIFEXITED(status) and os.WEXITSTATUS(status) and not (life.full or life.byte):
        raise AssertionError(f"life {number} ended with {os.WEXITSTATUS(status)}")
    assert told.account is not None or told.code or life.full, "it said nothing, and was not killed"
    assert time.monotonic() - begun < LIFE_SECONDS, "a wait without end"
    return told


def damage(folder: Path, dice: random.Random) -> str:
    """Damage the spool; return how."""
    files = [one for one in folder.glob("*.spool*") if "damaged" not in one.name]
    if not files:
        return ""
    path = dice.choice(files)
    data = bytearray(path.read_bytes())
    how = dice.choice(["bits", "page", "cut", "zeros", "rubbish", "deleted", "all deleted"])
    if how == "deleted":
        path.unlink()
    elif how == "all deleted":
        for one in files:
            one.unlink()
    elif not data:
        return ""
    elif how == "bits":
        for _ in range(dice.randrange(1, 20)):
            data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
    elif how == "cut":
        del data[dice.randrange(len(data)) :]
    else:
        size = min(4096, len(data)) if how != "rubbish" else len(data)
        begin = dice.randrange(len(data) - size + 1) // 4096 * 4096
        data[begin : begin + size] = bytes(size) if how == "zeros" else dice.randbytes(size)
    if "deleted" not in how:
        path.write_bytes(data)
    return f"{how} of {path.name}"


# ---------------------------------------------------------------------- the judge


Entry = tuple[int, int]
"""Epoch and number of an entry of one camera."""


class Arrived(NamedTuple):
    """Something that the far end has."""

    camera: str
    epoch: int
    number: int
    kind: str
    value: Any
    lost: int
    at_least: bool | int | None
    error: str | None


def journal_of(folder: Path) -> dict[str, Arrived]:
    """Return what the journal has, by id, as it came first."""
    found: dict[str, Arrived] = {}
    texts: dict[str, str] = {}
    for line in (folder / "journal").read_text().splitlines():
        name, camera, epoch, number, kind, _application, _at, body = json.loads(line)
        assert texts.setdefault(name, body) == body, f"{name} came with two contents"
        said = json.loads(body)
        arrived = Arrived(
            camera,
            epoch,
            number,
            kind,
            said.get("value"),
            said.get("lost", 0),
            said.get("at_least", False),
            said.get("error"),
        )
        found.setdefault(name, arrived)
    return found


def store_of(folder: Path) -> dict[str, Arrived]:
    """Return what the store has, by id."""
    with contextlib.closing(sqlite3.connect(folder / "results.sqlite")) as database:
        rows = database.execute(
            "SELECT id, camera, epoch, number, kind, value, lost, at_least, error FROM results "
            "ORDER BY rowid"
        ).fetchall()
        results = sum(row[4] == "result" for row in rows)
        if results:
            records = database.execute("SELECT COUNT(*) FROM app_1").fetchone()[0]
            assert records == results, "records without results"
    return {
        row[0]: Arrived(
            row[1], row[2], row[3], row[4], json.loads(row[5] or "null"), row[6] or 0, *row[7:]
        )
        for row in rows
    }


def judge(cell: Cell, lives: list[Lived], found: dict[str, Arrived]) -> collections.Counter[str]:
    """Compare what arrived with what was offered; return figures."""
    figures: collections.Counter[str] = collections.Counter()
    unknown: list[tuple[str, Entry]] = []
    for camera in {name for said in lives for name in said.offers}:
        missing = _missing(camera, lives, found)
        left = _uncovered(missing, camera, found)
        figures["told by a number"] += len(missing) - len(left)
        unknown += [(camera, one) for one in left]
    figures["told without a number"] = len(unknown)
    in_memory = sum(len(said.offers) - (said.kept - said.before) for said in lives)
    disturbed = any(said.disturbed for said in lives)
    assert disturbed or len(unknown) <= in_memory, f"{unknown} unknown, {in_memory} in memory"
    for camera, entry in unknown:
        damaged = disturbed and len(unknown) > in_memory
        assert _says_more(camera, entry, found, damaged), f"{camera} lacks {entry}: nobody says so"
    known = {one.epoch for one in lives}
    strange = [one for one in found.values() if one.kind != "gap" and one.epoch not in known]
    assert not strange, f"nobody offered {strange[:3]}"
    results = [one for one in found.values() if one.kind == "result"]
    places = [(one.value["life"], one.value["n"]) for one in results]
    assert len(set(places)) == len(places), "a result came under two ids"
    assert places == sorted(places), "results came in another order"
    account = lives[-1].account
    assert account is not None
    assert account["spooled"] == 0
    dropped = sum(account["dropped"].values())
    assert account["results"] == account["delivered"] + dropped, account
    if not cell.damages:
        assert account["delivered"] <= len(results) <= account["delivered"] + dropped, account
        assert "damaged" not in account["dropped"], account
    figures["offered"] = sum(len(one.offers) for one in lives)
    figures["arrived"] = len(results)
    figures["dropped, counted"] = dropped
    return figures


def _missing(camera: str, lives: list[Lived], found: dict[str, Arrived]) -> list[Entry]:
    """Return the entries of a camera that did not arrive; those that did are what was offered."""
    missing: list[Entry] = []
    for life, said in enumerate(lives):
        places = [n for n, name in enumerate(said.offers) if name == camera]
        here = {
            one.number: one
            for one in found.values()
            if (one.camera, one.epoch, one.kind) == (camera, said.epoch, "result")
        }
        assert here.keys() <= {*range(1, len(places) + 1)}, "a number that nobody offered"
        for number, one in here.items():
            wanted = value_of(life, places[number - 1])
            assert one.value == wanted, f"{camera} {number}: {one.value}, offered {wanted}"
        numbers = {*range(1, len(places) + 1)} - here.keys()
        missing += [(said.epoch, number) for number in sorted(numbers)]
    return missing


def _uncovered(missing: list[Entry], camera: str, found: dict[str, Arrived]) -> list[Entry]:
    """Return the missing entries that no gap counts; a gap counts entries up to its own number."""
    gaps = sorted(
        ((one.epoch, one.number), one.lost)
        for one in found.values()
        if (one.camera, one.kind) == (camera, "gap") and one.lost
    )
    left = [*missing]
    for last, lost in gaps:
        covered = [one for one in left if one <= last][-lost:]
        left = [one for one in left if one not in covered]
    return left


def _says_more(camera: str, entry: Entry, found: dict[str, Arrived], damaged: bool) -> bool:
    """Return True if a gap of the camera, or of all, says that more may be missing there."""
    for one in found.values():
        if one.kind != "gap" or not one.at_least:
            continue
        tells_damage = "damaged" in (one.error or "") or "is gone" in (one.error or "")
        last = one.epoch, one.number
        if one.camera == "" and one.epoch == entry[0]:
            return True
        there = tells_damage >= damaged or _stands_there(one, camera, entry, found)
        if one.camera == "" and one.epoch > entry[0] and there:
            return True
        if one.camera == camera and (entry < last or (one.epoch == entry[0] and last <= entry)):
            return True
    return False


def _stands_there(gap: Arrived, camera: str, entry: Entry, found: dict[str, Arrived]) -> bool:
    """Return True if a gap came where an entry is missing: gaps of several starts may be one."""
    came = [*found.values()]
    place = came.index(gap)
    sides = [
        [(one.epoch, one.number) for one in side if (one.camera, one.kind) == (camera, "result")]
        for side in (came[:place], came[place:])
    ]
    return all(one < entry for one in sides[0]) and all(one > entry for one in sides[1])


# ---------------------------------------------------------------------- cells


def run_cell(cell: Cell, folder: Path) -> collections.Counter[str]:
    """Have a cell's lives lived; return figures.

    Raises:
        AssertionError: something was lost unseen, or came twice.
    """
    far = FarEnd(cell, folder)
    outlet: dict[str, Any] = {"kind": "sqlite", "file": "results.sqlite", "spool": "."}
    if cell.journal:
        outlet = {"kind": "journal", "port": far.port, "spool": ".", "timeout": 0.1}
    lives: list[Lived] = []
    damaged: list[str] = []
    try:
        for number in range(len(cell.lives)):
            if cell.lives[number].drains:
                far.stop()  # the last one has no faults
            lives.append(lived(number, cell, {"out": outlet}, folder, far))
            if cell.damages and number < len(cell.lives) - 1:
                how = damage(folder, cell.dice)
                damaged.append(how)
                lives[-1].disturbed = bool(how)
    finally:
        far.close()
    try:
        figures = judge(cell, lives, journal_of(folder) if cell.journal else store_of(folder))
    except AssertionError as exc:
        exc.add_note(f"lives {[(one.epoch, one.code) for one in lives]}, damaged: {damaged}")
        raise
    figures["lives"] = len(lives)
    figures["killed"] = sum(one.code != 0 for one in lives)
    figures["far end killed"] = far.deaths
    return figures


def cells(seed: int, numbers: Iterator[int] | range, keep: Path | None) -> tuple[int, Any]:
    """Run cells; return how many failed, and the figures of each kind."""
    failed = 0
    figures: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    base = "/dev/shm" if Path("/dev/shm").is_dir() else None  # noqa: S108 - a kill leaves it alone
    for number in numbers:
        cell = plan(seed, number)
        folder = Path(tempfile.mkdtemp(dir=keep or base, prefix=f"outlets-{number}-"))
        try:
            figures[cell.kind] += run_cell(cell, folder) + collections.Counter(cells=1)
        except Exception as exc:  # noqa: BLE001 - reported, and the proof goes on
            failed += 1
            notes = " ".join(getattr(exc, "__notes__", []))
            print(f"FAILED cell {number} ({cell.kind}): {exc!r:.600} {notes}")  # noqa: T201
            if keep is not None:
                continue
        for one in folder.iterdir():
            one.unlink()
        folder.rmdir()
    return failed, figures


def main(arguments: list[str] | None = None) -> int:
    """Run cells and print what became of them; 1 if something was lost unseen or doubled."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cells", type=int, default=3000, help="number of cells")
    parser.add_argument("--first", type=int, default=0, help="number of the first cell")
    parser.add_argument("--seed", type=int, default=1, help="seed of all plans")
    parser.add_argument("--keep", type=Path, help="folder in which failed cells stay")
    options = parser.parse_args(arguments)
    begun = time.monotonic()
    numbers = range(options.first, options.first + options.cells)
    if options.keep is not None:
        options.keep.mkdir(parents=True, exist_ok=True)
    failed, figures = cells(options.seed, numbers, options.keep)
    total: collections.Counter[str] = collections.Counter()
    for kind, each in figures.items():
        total += each
        print(f"{kind}: {_text(each)}")  # noqa: T201
    seconds = time.monotonic() - begun
    print(f"seed {options.seed}, {seconds:.0f} s: {_text(total)}; {failed} cells failed")  # noqa: T201
    return 1 if failed else 0


def _text(figures: collections.Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in sorted(figures.items()))


if __name__ == "__main__":
    sys.exit(main())
