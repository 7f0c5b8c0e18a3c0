"""The hosts of a plant, their processes, and the reports of these."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from smartcam.fleet._inside import make_certificates
from tests import ROOT
from tests.proofs.plant_hosts import HUB, LINE, SITES, Switch, address, run
from tests.proofs.plant_judge import Storm
from tests.proofs.plant_pace import Limit
from tests.proofs.plant_pair import PAIR, PAIRED, Pair, Told
from tests.proofs.plant_part import START, Part

PORT = 7447
TOKENS = 1_000_000
"""That each program has for itself."""

DISK = 16 << 20
MARGIN = 2.0
"""Seconds of work beyond the lease, for processes that share two cores."""

TURN = 0.5
"""Seconds at most between two looks whether time is up."""

FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")
CLOCKS = {2: "+1h", 3: "-1h"}

FLEET = """\
agent: host{number}
connect: tls/{hub}:{port}
certificates: {keys}/host{number}
standby: {standby}
history: {{results: 12}}
record: {{folder: {disk}, size: 0.3 MB, keep: 4 MB}}
cameras:
"""


class Site:
    """The plant: its processes, and what they say.

    Args:
        storm: what comes of it.
        switch: between the hosts.
        folder: for files.
        each: cameras of a host.
        seed: of the programs.

    Attributes:
        names: all cameras.
        here: those that each program sees connected.
        kills: of agents, by host.
        recording: whether each agent records, as it said last.
        sessions: how many each camera has had, those of the pair apart.
        pair: who has the cameras of the pair.
        told: how often each program was told that one of these was lost.
        renamed: cameras whose results have been told under another name for a while.
        tokens: of guests.
    """

    def __init__(self, storm: Storm, switch: Switch, folder: Path, each: int, seed: int) -> None:
        self.storm, self.switch, self.folder, self.each = storm, switch, folder, each
        self.pace = storm.pace
        self.seed = seed
        self.names = [f"host{site}/cam{one}" for site in SITES for one in range(1, each + 1)]
        self.names += PAIRED
        self.here: dict[int, list[str]] = {}
        self.pair = Pair()
        self.told: Told = {}
        self.accounts: dict[int, Any] = {}
        self.kills: Counter[int] = Counter()
        self.renamed: set[str] = set()
        self.tokens = itertools.count((HUB + LINE) * TOKENS)
        self.recording: dict[int, bool] = {}
        self.sessions: Counter[str] = Counter()
        self.clocks = FAKETIME.exists()
        self.boxes: dict[int, Part] = {}
        self.agents: dict[int, Part] = {}
        self.programs: dict[int, Part] = {}
        self.router: Part
        self._looked: Counter[int] = Counter()  # how often each program said what it sees
        self._having: dict[int, dict[str, list[str]]] = {}  # agents that each sees, by camera
        self._changed = asyncio.Event()
        self._urls: dict[int, list[str]] = {}
        self._beside: list[asyncio.Task[None]] = []
        self._stack = contextlib.AsyncExitStack()

    @property
    def keys(self) -> Path:
        """The folder of the certificates."""
        return self.folder / "keys"

    def disk(self, site: int) -> Path:
        """Return the folder in which a host records, on a disk of its own."""
        return self.folder / f"disk{site}"

    def url(self, who: str) -> str:
        """Return the fleet's URL, with the certificate of somebody."""
        return f"fleet+tls://{address(HUB)}:{PORT}?certificates={self.keys / who}"

    # ------------------------------------------------------------------ life

    async def __aenter__(self) -> Self:
        try:
            await self._open()
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._stack.aclose()

    async def _open(self) -> None:
        names = {
            "agent": [f"host{site}" for site in SITES],
            "operator": [*(f"robot{site}" for site in SITES), "visitor", "guest"],
            "router": ["hub"],
        }
        await asyncio.to_thread(make_certificates, self.keys, names, hosts=[address(HUB)])
        if not self.clocks:
            self.storm.notes.append("faketime is not here: all clocks are the same")
        place = f"tls/{address(HUB)}:{PORT}"
        self.router = self.part(HUB, "router", "router", place, str(self.keys / "hub"))
        await self.router.come()
        for site in SITES:
            self.boxes[site] = self.part(site, f"cameras {site}", "cameras", str(self.each))
            await self._mount(self.disk(site))
        line = (str(len(PAIRED)), address(LINE))
        self.boxes[LINE] = self.part(LINE, "cameras of the pair", "cameras", *line)
        await asyncio.gather(*(one.come() for one in self.boxes.values()))
        for site in SITES:
            path = self.folder / f"host{site}.yaml"
            path.write_text(self._file(site), encoding="utf-8")
            self.agents[site] = self.part(site, f"agent {site}", "agent", str(path))
        first, *others = self.agents.values()
        await first.come()  # it has the cameras of the pair
        await asyncio.gather(*(one.come() for one in others))
        for site in SITES:
            given = (self.url(f"robot{site}"), str(site * TOKENS), str(self.seed))
            self.programs[site] = self.part(site, f"program {site}", "program", *given)
        await asyncio.gather(*(one.come() for one in self.programs.values()))
        await self.all_here(Limit(START))
        self._beside = [asyncio.create_task(one) for one in (self._sample(), self.pace.run())]
        self._stack.callback(lambda: [one.cancel() for one in self._beside])

    async def _mount(self, folder: Path) -> None:
        await asyncio.to_thread(folder.mkdir)
        options = ("-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(folder))
        await asyncio.to_thread(run, "mount", *options)
        self._stack.callback(run, "umount", "-l", str(folder))

    def _file(self, site: int) -> str:
        """Return the fleet file of a host."""
        said = FLEET.format(
            number=site,
            hub=address(HUB),
            port=PORT,
            keys=self.keys,
            disk=self.disk(site),
            standby=str(site in PAIR).lower(),
        )
        cameras = {f"host{site}/cam{at}": url for at, url in enumerate(self._urls[site], 1)}
        if site in PAIR:
            cameras |= dict(zip(PAIRED, self._urls[LINE], strict=True))
        return said + "".join(
            f'  {name}: {{url: "{url}", reconnect: {{maximum: 1}}}}\n'
            for name, url in cameras.items()
        )

    def part(
        self, host: int, name: str, kind: str, *given: str, hear: list[Any] | None = None
    ) -> Part:
        """Return a process, to be started; it ends with the plant.

        Args:
            host: where.
            name: of it.
            kind: of it.
            *given: its arguments.
            hear: gets what it says, instead of the plant.
        """
        module = ("tests.proofs.plant_process", kind, *given)
        if kind == "agent":
            module = ("smartcam", "serve", "--json", *given)
        within = [*self.switch.within(host)]
        offset = CLOCKS.get(host)
        if offset is not None and self.clocks:
            within += ["env", f"LD_PRELOAD={FAKETIME}", f"FAKETIME={offset}"]
            within += ["FAKETIME_DONT_FAKE_MONOTONIC=1"]
        command = [*within, sys.executable, "-m", *module]
        take = (lambda said: self._hear(host, said)) if hear is None else hear.append
        made = Part(name, command, {"PYTHONPATH": str(ROOT)}, take)
        self._stack.push_async_callback(made.kill)
        return made

    # ------------------------------------------------------------------ what is said

    def _hear(self, host: int, said: dict[str, Any]) -> None:
        storm = self.storm
        if "urls" in said:
            self._urls[host] = said["urls"]
        elif "here" in said:
            self.here[host], self._having[host] = said["here"], said["having"]
            self.told[host] = said["told"]
            self._looked[host] += 1
            self._changed.set()
        elif "session" in said:
            number, of = said["session"]
            if of is not None and host != LINE:
                self.sessions[f"host{host}/cam{number + 1}"] += 1
            if host == LINE:
                self.pair.hear(PAIRED[number], of)
                self._changed.set()
        elif "call" in said:
            storm.figures.take(*said["call"])
        elif "block" in said:
            camera, outcome = said["block"]
            storm.blocks[outcome if not outcome.startswith("!") else "!"] += 1
            if outcome.startswith("!"):
                storm.complain(f"reserved block of {camera} by program {host}: {outcome}")
        elif "memory" in said:
            storm.memory[f"program {host}"].append(said["memory"])
        elif "account" in said:
            self.accounts[host] = said["account"]
            storm.figures.violations += [f"program {host}: {text}" for text in said["ends"]]
        elif "recordings" in said:
            self.recording[host] = said["recording"]
            self._changed.set()
        elif "executed" in said:
            storm.figures.executed += said["executed"]
            for token, count in said["twice"].items():
                storm.complain(f"call {token} was executed {count} times")

    async def _sample(self) -> None:
        looked: dict[str, int] = {}
        while True:
            await asyncio.sleep(2.0)
            for part in (self.router, *self.agents.values()):
                found, memory = part.resident(), self.storm.memory[part.name]
                if looked.get(part.name) != part.process.pid:
                    looked[part.name] = part.process.pid
                    memory.clear()  # of the process that was killed
                if found:
                    memory.append(found)

    # ------------------------------------------------------------------ presence

    async def all_here(self, limit: Limit) -> float | None:
        """Wait until every program sees all cameras, and one agent for each of the pair's.

        What a program said before does not count: it may have been stopped.

        Returns:
            The seconds that it took; None where that was too long.
        """
        before = self._looked.copy()
        return await self.until(
            lambda: all(
                self.here.get(site) == self.names
                and self.pair.agreed(self._having[site])
                and self._looked[site] > before[site] + 1
                for site in SITES
            ),
            limit,
        )

    async def until(self, condition: Callable[[], bool], limit: Limit) -> float | None:
        """Wait until something is so; return the seconds that it took, None where too long.

        The time that there is goes by this computer's pace. That it was needed is noted.
        """
        begun = time.monotonic()
        while not condition():
            left = self.pace.end(begun, limit) - time.monotonic()
            if left <= 0:
                return None
            self._changed.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(min(TURN, left)):
                    await self._changed.wait()
        took = time.monotonic() - begun
        if took > limit.seconds:
            slow = self.pace.since(begun)
            self.storm.notes.append(
                f"{took:.1f} s instead of {limit.seconds:g} s on a computer {slow:.1f} times slower"
            )
        return took

    def missing(self) -> str:
        """Say who sees what not."""
        lacking = [
            f"program {site} lacks {sorted({*self.names} - {*self.here.get(site, ())})}"
            for site in SITES
            if self.here.get(site) != self.names
        ]
        return "; ".join([*lacking, f"agents of the pair: {self._having}", str(self.pair)])

    # ------------------------------------------------------------------ the end

    async def end(self) -> None:
        """Have all end as they should, and judge what they say."""
        for task in self._beside:
            task.cancel()
        programs = (self._end(one, 4 * START) for one in self.programs.values())
        await asyncio.gather(*programs)
        for part in self.agents.values():
            await self._end(part, START, number=signal.SIGTERM)
        for part in self.boxes.values():
            await self._end(part, START)
        for site, accounts in self.accounts.items():
            for name in self.names:
                if name in self.renamed:
                    continue
                # what a camera has sent into a session that ends may be lost with it
                losses = self.told[site][name] if name in PAIRED else self.sessions[name] - 1
                what = f"program {site}: {name}"
                self.storm.judge_account(what, losses, accounts.get(name))
        for name, sessions in self.sessions.items():
            if sessions != 1 + self.kills[int(name[4])]:
                self.storm.notes.append(f"{name} has had {sessions} sessions")
        self.storm.judge_memory()

    async def _end(self, part: Part, seconds: float, *, number: int | None = None) -> None:
        code = await part.ask_to_end(seconds, number=number)
        if code != 0:
            self.storm.complain(f"{part.name} ended with {code}: {[*part.last]}")
