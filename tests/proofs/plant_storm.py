"""A plant of several hosts to which everything happens that can: whose result is whose, and where?

Three hosts are network namespaces with a switch between them, and a router on a fourth. Each has
a process with emulated cameras, an agent for them, and a program that reads the results of all
cameras and triggers one after the other. Faults come by a seeded plan, one or two at a time: an
agent killed, the router killed, a cable cut, loss, delay, a program stopped, a disk filled, a
certificate that has expired. Where faketime is installed, the clocks of two hosts are an hour off.

Each trigger brings a number of its own, which its result has; each run of a camera has one, too.

Long form: ``python -m tests.proofs.plant_storm --seconds 600 --seed 1`` (needs the rights to make
namespaces; prints its figures, exit 1 on a violation).
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict, deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from random import Random
from typing import Any, Self

from smartcam._zenoh import LEASE
from smartcam.fleet._authority import make_certificates
from tests import ROOT
from tests.fleet.fleetkit import PATIENCE
from tests.proofs.chaos_soak import GROWTH, quarters
from tests.proofs.fleet_storm import Figures
from tests.proofs.plant_hosts import NoNamespacesError, Switch, address, hosts, run
from tests.recording.full_disk import fill

HUB = 4
"""The router's host; those before it have cameras."""

SITES = range(1, HUB)
PORT = 7447
TOKENS = 1_000_000
"""That each program has for itself."""

DISK = 16 << 20
CALLS = 30
"""That end while a disk is full."""

MARGIN = 2.0
"""Seconds beyond the lease, for processes that share two cores."""

LEAST_SAMPLES = 30
"""Looks at the memory of a process before it is judged: at first it fills its caches."""

START = 30.0
"""Seconds that a process may take until it is ready."""

FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")
CLOCKS = {2: "+1h", 3: "-1h"}

FLEET = """\
agent: host{number}
connect: tls/{hub}:{port}
certificates: {keys}/host{number}
history: {{results: 12}}
record: {{folder: {disk}, size: 0.3 MB, keep: 4 MB}}
cameras:
"""


@dataclass
class Storm:
    """What was done to a plant, and what came of it."""

    figures: Figures = field(default_factory=lambda: Figures("plant"))
    done: Counter[str] = field(default_factory=Counter)  # faults
    right: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Seconds until presence was right again after each."""
    accounts: Counter[str] = field(default_factory=Counter)  # all programs'
    memory: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    notes: list[str] = field(default_factory=list)

    def complain(self, text: str) -> None:
        """Note what must not be."""
        self.figures.violations.append(text)

    def report(self) -> str:
        """Return it as text."""
        figures = self.figures
        lines = [
            f"{figures.seconds:.0f} s, {self.done.total()} faults",
            *(
                f"  {name}: {count}; presence right after at most "
                f"{max(self.right[name], default=0.0):.1f} s"
                for name, count in sorted(self.done.items())
            ),
            f"{figures.calls} calls, {figures.executed} executed: "
            + ", ".join(f"{name} {count}" for name, count in figures.outcomes.most_common()),
            "accounts: " + ", ".join(f"{name} {count}" for name, count in self.accounts.items()),
        ]
        for name, values in sorted(self.memory.items()):
            if not values:
                continue
            first, last = quarters(values)
            lines.append(f"  memory of {name}: {first:.1f}, then {last:.1f} MB")
        lines += [f"note: {text}" for text in self.notes]
        lines += [f"VIOLATION {text}" for text in figures.violations[:50]]
        return "\n".join([*lines, f"{len(figures.violations)} violations"])


class Part:
    """A process on a host that says lines of JSON.

    Args:
        command: what runs.
        hear: takes what it says.
    """

    def __init__(
        self, name: str, command: Sequence[str], env: dict[str, str], hear: Callable[[Any], None]
    ) -> None:
        self.name = name
        self.ready = asyncio.Event()
        self.last: deque[str] = deque(maxlen=20)  # lines of stderr
        self._command, self._env, self._hear = command, env, hear
        self.process: asyncio.subprocess.Process
        self._reading: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Start it; it is not ready yet."""
        self.ready.clear()
        pipe = asyncio.subprocess.PIPE
        self.process = await asyncio.create_subprocess_exec(
            *self._command,
            cwd=ROOT,
            env={**os.environ, **self._env},
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            limit=1 << 24,
        )
        self._reading = [asyncio.create_task(one) for one in (self._read(), self._read_errors())]

    async def _read(self) -> None:
        assert self.process.stdout is not None
        async for line in self.process.stdout:
            if line.endswith(b"\n"):
                self._hear(json.loads(line))
                self.ready.set()

    async def _read_errors(self) -> None:
        assert self.process.stderr is not None
        async for line in self.process.stderr:
            self.last.append(line.decode(errors="replace").rstrip())

    async def come(self) -> None:
        """Start it, and wait until it is ready; again where it ends, as a supervisor does."""
        async with asyncio.timeout(START + PATIENCE):
            while True:
                await self.start()
                ready = asyncio.create_task(self.ready.wait())
                await asyncio.wait({ready, self._reading[0]}, return_when=asyncio.FIRST_COMPLETED)
                if self.ready.is_set():
                    return
                ready.cancel()
                await self.ended()
                await asyncio.sleep(0.5)

    def signal(self, number: int) -> None:
        """Send it a signal."""
        if self.process.returncode is None:
            self.process.send_signal(number)

    async def ended(self) -> int:
        """Wait until it has ended."""
        await asyncio.gather(*self._reading)
        return await self.process.wait()

    async def kill(self) -> None:
        """End it without a word."""
        self.signal(signal.SIGKILL)
        await self.ended()

    async def ask_to_end(self, seconds: float) -> int | None:
        """Have it end; None where it takes too long."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.write(b"\n")
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                return await self.ended()
        return None

    def resident(self) -> float | None:
        """Return its memory, MB."""
        with contextlib.suppress(OSError, StopIteration):
            status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii")
            return next(
                int(line.split()[1]) / 1024
                for line in status.splitlines()
                if line.startswith("VmRSS")
            )
        return None


class Site:
    """The plant: its processes, and what they say.

    Args:
        each: cameras of a host.
    """

    def __init__(self, storm: Storm, switch: Switch, folder: Path, each: int, seed: int) -> None:
        self.storm, self.switch, self.folder, self.each = storm, switch, folder, each
        self.chance = Random(seed)  # noqa: S311
        self.seed = seed
        self.names = [f"host{site}/cam{one}" for site in SITES for one in range(1, each + 1)]
        self.here: dict[int, list[str]] = {}  # cameras that each program sees connected
        self.looked: Counter[int] = Counter()  # how often it said so
        self.changed = asyncio.Event()
        self.accounts: dict[int, Any] = {}
        self.kills: Counter[int] = Counter()  # of agents
        self.recording: dict[int, bool] = {}  # what agents told last, if they did
        self.clocks = FAKETIME.exists()
        self.boxes: dict[int, Part] = {}
        self.agents: dict[int, Part] = {}
        self.programs: dict[int, Part] = {}
        self.router: Part
        self._urls: dict[int, list[str]] = {}
        self._sampling: asyncio.Task[None]
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
            "operator": [*(f"robot{site}" for site in SITES), "visitor"],
            "router": ["hub"],
        }
        await asyncio.to_thread(make_certificates, self.keys, names, hosts=[address(HUB)])
        if not self.clocks:
            self.storm.notes.append("faketime is not here: all clocks are the same")
        self.router = self.part(HUB, "router", "router", f"tls/{address(HUB)}:{PORT}", "hub")
        await self.router.come()
        for site in SITES:
            self.boxes[site] = self.part(site, f"cameras {site}", "cameras", str(self.each))
            self.disk(site).mkdir()
            options = ("-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(self.disk(site)))
            await asyncio.to_thread(run, "mount", *options)
            self._stack.callback(run, "umount", "-l", str(self.disk(site)))
        await asyncio.gather(*(one.come() for one in self.boxes.values()))
        for site in SITES:
            text = FLEET.format(
                number=site, hub=address(HUB), port=PORT, keys=self.keys, disk=self.disk(site)
            )
            for number, url in enumerate(self._urls[site], 1):
                text += f'  host{site}/cam{number}: {{url: "{url}"}}\n'
            path = self.folder / f"host{site}.yaml"
            path.write_text(text, encoding="utf-8")
            self.agents[site] = self.part(site, f"agent {site}", "agent", str(path))
        await asyncio.gather(*(one.come() for one in self.agents.values()))
        for site in SITES:
            given = (self.url(f"robot{site}"), str(site * TOKENS), str(len(self.names)))
            self.programs[site] = self.part(
                site, f"program {site}", "program", *given, str(self.seed)
            )
        await asyncio.gather(*(one.come() for one in self.programs.values()))
        await self.all_here(START)
        self._sampling = asyncio.create_task(self._sample())

    def part(self, host: int, name: str, kind: str, *given: str) -> Part:
        """Return a process, to be started; it ends with the plant."""
        arguments = list(given)
        if kind == "router":
            arguments[1] = str(self.keys / arguments[1])
        module = ("tests.proofs.plant_process", kind)
        if kind == "agent":
            module, arguments = ("smartcam", "serve"), ["--json", *arguments]
        env = {"PYTHONPATH": str(ROOT)}
        offset = CLOCKS.get(host)
        within = [*self.switch.within(host)]
        if offset is not None and self.clocks:
            within += ["env", f"LD_PRELOAD={FAKETIME}", f"FAKETIME={offset}"]
            within += ["FAKETIME_DONT_FAKE_MONOTONIC=1"]
        command = [*within, sys.executable, "-m", *module, *arguments]
        made = Part(name, command, env, lambda said: self._hear(host, kind, said))
        self._stack.push_async_callback(self._end, made)
        return made

    async def _end(self, part: Part) -> None:
        if getattr(part, "process", None) is not None:
            await part.kill()

    def _hear(self, host: int, kind: str, said: Any) -> None:
        storm = self.storm
        if "urls" in said:
            self._urls[host] = said["urls"]
        elif "here" in said:
            self.here[host] = said["here"]
            self.looked[host] += 1
            self.changed.set()
        elif "call" in said:
            storm.figures.take(*said["call"])
        elif "memory" in said:
            storm.memory[f"program {host}"].append(said["memory"])
        elif "account" in said:
            self.accounts[host] = said["account"]
            storm.figures.violations += [f"program {host}: {text}" for text in said["ends"]]
        elif "recordings" in said:
            self.recording[host] = said["recording"]
        elif "executed" in said:
            storm.figures.executed += said["executed"]
            for token, count in said["twice"].items():
                storm.complain(f"call {token} was executed {count} times")

    async def _sample(self) -> None:
        while True:
            await asyncio.sleep(2.0)
            for part in (self.router, *self.agents.values()):
                found = part.resident()
                if found:
                    self.storm.memory[part.name].append(found)

    # ------------------------------------------------------------------ presence

    async def all_here(self, seconds: float) -> float | None:
        """Wait until every program sees all cameras; return how long it took.

        What a program said before does not count: it may have been stopped.
        """
        before = self.looked.copy()
        return await self.until(
            lambda: all(
                self.here.get(site) == self.names and self.looked[site] > before[site] + 1
                for site in SITES
            ),
            seconds,
        )

    async def until(self, condition: Callable[[], bool], seconds: float) -> float | None:
        """Wait until programs see what they should; None where it takes too long."""
        begun = time.monotonic()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while not condition():
                    self.changed.clear()
                    await self.changed.wait()
                return time.monotonic() - begun
        return None

    def missing(self) -> str:
        """Say who sees what not."""
        return "; ".join(
            f"program {site} lacks {sorted({*self.names} - {*self.here.get(site, ())})}"
            for site in SITES
            if self.here.get(site) != self.names
        )

    # ------------------------------------------------------------------ the end

    async def account(self) -> None:
        """Have all end, and judge what they say."""
        self._sampling.cancel()
        ends = await asyncio.gather(*(one.ask_to_end(4 * START) for one in self.programs.values()))
        for part, code in zip(self.programs.values(), ends, strict=True):
            if code != 0:
                self.storm.complain(f"{part.name} ended with {code}: {[*part.last]}")
        for part in self.agents.values():
            part.signal(signal.SIGTERM)
            try:
                async with asyncio.timeout(START):
                    code = await part.ended()
            except TimeoutError:
                code = None
            if code != 0:
                self.storm.complain(f"{part.name} ended with {code}: {[*part.last]}")
        for part in self.boxes.values():
            if await part.ask_to_end(START) != 0:
                self.storm.complain(f"{part.name}: {[*part.last]}")
        for site, accounts in self.accounts.items():
            for name in self.names:
                self._judge(f"program {site}: {name}", self.kills[int(name[4])], accounts.get(name))
        self._judge_memory()

    def _judge(self, what: str, kills: int, account: Any) -> None:
        """Look whether every result of a camera is in an account of a program's."""
        storm = self.storm
        if account is None:
            storm.complain(f"{what} has no account")
            return
        counts = {key: value for key, value in account.items() if isinstance(value, int)}
        for key in ("taken", "dropped", "missed"):
            storm.accounts[key] += counts[key]
        if account["again"]:
            storm.complain(f"{what}: {account['again']} results came once more: {account}")
        if counts["offered"] != counts["taken"] + counts["dropped"] + counts["queued"]:
            storm.complain(f"{what} does not balance: {account}")
        if counts["taken"] != counts["seen"]:
            storm.complain(f"{what}: not what it took: {account}")
        # what a killed agent had told nobody is in no account: a gap for each kill
        gaps = sorted(account["gaps"])
        told = counts["dropped"] + counts["missed"]
        storm.accounts["gaps of killed agents"] += sum(gaps[len(gaps) - kills :] if kills else [])
        if not kills and told > sum(gaps):
            storm.complain(f"{what} has more in its account than it lacks: {account}")
        if sum(gaps[: max(0, len(gaps) - kills)]) > told:
            storm.complain(f"{what} lacks results that are in no account: {account}, {kills} kills")

    def _judge_memory(self) -> None:
        for name, values in self.storm.memory.items():
            if len(values) < LEAST_SAMPLES:
                continue
            first, last = quarters(values)
            if last > first + GROWTH:
                self.storm.complain(f"{name}: memory grew from {first:.1f} to {last:.1f} MB")


# ---------------------------------------------------------------------- faults


@dataclass
class Fault:
    """What may happen.

    Attributes:
        act: does it to a host, for so many seconds.
        seconds: how long it may last; one of them, by chance.
    """

    act: Callable[[Site, int, float], Awaitable[None]]
    seconds: tuple[float, ...]


async def agent_killed(site: Site, host: int, seconds: float) -> None:
    site.kills[host] += 1
    await site.agents[host].kill()
    site.storm.memory[site.agents[host].name].clear()
    await asyncio.sleep(seconds)
    await site.agents[host].come()


async def router_killed(site: Site, host: int, seconds: float) -> None:
    await site.router.kill()
    site.storm.memory[site.router.name].clear()
    await asyncio.sleep(seconds)
    await site.router.come()


async def cable_cut(site: Site, host: int, seconds: float) -> None:
    cable = site.switch.cables[host]
    cable.cut = True
    begun = time.monotonic()
    if seconds > LEASE + MARGIN:
        others = [one for one in SITES if one != host]
        cut = {name for name in site.names if name.startswith(f"host{host}/")}
        gone = await site.until(
            lambda: not any(cut & {*site.here[one]} for one in others), LEASE + MARGIN
        )
        if gone is None:
            site.storm.complain(
                f"cable of host {host} cut: its cameras are here {LEASE + MARGIN:g} s later"
            )
    await asyncio.sleep(begun + seconds - time.monotonic())
    cable.cut = False


async def packets_lost(site: Site, host: int, seconds: float) -> None:
    site.switch.cables[host].loss = 0.05
    await asyncio.sleep(seconds)
    site.switch.cables[host].loss = 0.0


async def packets_late(site: Site, host: int, seconds: float) -> None:
    site.switch.cables[host].delay = 0.2
    await asyncio.sleep(seconds)
    site.switch.cables[host].delay = 0.0


async def program_stopped(site: Site, host: int, seconds: float) -> None:
    site.programs[host].signal(signal.SIGSTOP)
    await asyncio.sleep(seconds)
    site.programs[host].signal(signal.SIGCONT)


async def disk_full(site: Site, host: int, seconds: float) -> None:
    ballast = site.disk(host) / "ballast"
    begun = time.monotonic()
    site.recording.pop(host, None)
    await asyncio.to_thread(fill, ballast)
    if await site.until(lambda: site.recording.get(host) is False, START) is None:
        site.storm.complain(f"disk of host {host} full: the agent did not say so")
    seen = site.storm.figures.calls
    await asyncio.sleep(begun + seconds - time.monotonic())
    await site.until(lambda: site.storm.figures.calls > seen + CALLS, START)
    ballast.unlink()
    if await site.until(lambda: site.recording.get(host) is True, START) is None:
        site.storm.complain(f"disk of host {host} cleared: it does not record again")


async def certificate_expired(site: Site, host: int, seconds: float) -> None:
    """Have somebody come whose certificate has expired, and again with a new one."""

    async def visit() -> Any:
        said: list[Any] = []
        part = site.part(1, "visitor", "visitor", site.url("visitor"), f"{seconds:g}")
        part._hear = said.append
        await part.start()
        async with asyncio.timeout(START + PATIENCE):
            await part.ended()
        if not said:
            site.storm.complain(f"a visitor said nothing: {[*part.last]}")
            return {"outcome": "", "text": ""}
        if said[0]["took"] > seconds + MARGIN:
            site.storm.complain(f"a visitor came to an end after {said[0]['took']:.1f} s")
        return said[0]

    (site.keys / "visitor" / "cert.pem").unlink()
    lifetime = timedelta(hours=-3)  # by all clocks
    await asyncio.to_thread(
        make_certificates, site.keys, {"operator": ["visitor"]}, lifetime=lifetime
    )
    said = await visit()
    if said["outcome"] != "ConnectFailedError" or "expired" not in said["text"]:
        site.storm.complain(f"a visitor whose certificate has expired: {said}")
    await asyncio.to_thread(make_certificates, site.keys, {"operator": ["visitor"]})
    said = await visit()
    if said["outcome"] not in {"here", "ConnectFailedError"} or "expired" in said["text"]:
        site.storm.complain(f"a visitor with a renewed certificate: {said}")


FAULTS: dict[str, Fault] = {
    "agent killed": Fault(agent_killed, (0.0, 1.0, 3.0)),
    "router killed": Fault(router_killed, (0.5, 3.0)),
    "cable cut": Fault(cable_cut, (1.0, 10.0)),
    "cable cut for a minute": Fault(cable_cut, (60.0,)),
    "5 % of packets lost": Fault(packets_lost, (5.0, 15.0)),
    "packets 200 ms late": Fault(packets_late, (5.0, 15.0)),
    "program stopped": Fault(program_stopped, (1.0, 12.0)),
    "disk full": Fault(disk_full, (5.0,)),
    "certificate expired": Fault(certificate_expired, (10.0,)),
}

RARE = {"cable cut for a minute": 0.1}
QUIET = 1.0
"""Seconds between two rounds."""

SHORT: tuple[tuple[tuple[str, int, float], ...], ...] = (
    (("cable cut", 2, 1.0), ("disk full", 1, 1.5)),
    (("agent killed", 3, 0.0), ("packets 200 ms late", 1, 2.0)),
    (("program stopped", 2, 5.0), ("5 % of packets lost", 3, 2.0)),
    (("router killed", 4, 0.5),),
    (("certificate expired", 1, 10.0),),
)
"""Rounds of the short form: each fault once, on which host, for how many seconds."""


def rounds_by_chance(chance: Random) -> list[tuple[str, int, float]]:
    """Return one or two faults that happen together, on hosts of their own."""
    names = [*FAULTS]
    victims = chance.sample([*SITES], chance.choice((1, 2, 2)))
    found: dict[str, tuple[str, int, float]] = {}
    for host in victims:
        (name,) = chance.choices(names, [RARE.get(one, 1.0) for one in names])
        found[name] = (name, host, chance.choice(FAULTS[name].seconds))
    return [*found.values()]


async def weather(site: Site, faults: Sequence[tuple[str, int, float]]) -> None:
    """Have faults happen together; presence is right within the lease after the last."""
    storm = site.storm
    name = " and ".join(sorted(one for one, _, _ in faults))
    await asyncio.gather(*(FAULTS[one].act(site, host, for_) for one, host, for_ in faults))
    for one, _, _ in faults:
        storm.done[one] += 1
    took = await site.all_here(LEASE + MARGIN)
    if took is None:
        storm.complain(f"{faults}: not right {LEASE + MARGIN:g} s later: {site.missing()}")
        more = await site.all_here(PATIENCE)
        took = LEASE + MARGIN + (PATIENCE if more is None else more)
        storm.notes.append(f"{name}: presence was right after {took:.1f} s")
    for one, _, _ in faults:
        storm.right[one].append(took)
    await asyncio.sleep(QUIET)


async def storm_over(
    switch: Switch, *, cameras: int, seed: int, seconds: float | None, say: Callable[[str], None]
) -> Storm:
    """Have a storm over a plant; without ``seconds`` the short form's."""
    storm = Storm()
    chance = Random(f"{seed} plan")  # noqa: S311
    with tempfile.TemporaryDirectory() as folder:
        async with Site(storm, switch, Path(folder), -(-cameras // len(SITES)), seed) as site:
            begun = time.monotonic()

            async def have(faults: Sequence[tuple[str, int, float]]) -> None:
                say(f"{time.monotonic() - begun:6.1f} s  {[*faults]}")
                await weather(site, faults)

            if seconds is None:
                for faults in SHORT:
                    await have(faults)
            else:
                while time.monotonic() - begun < seconds:
                    await have(rounds_by_chance(chance))
            await site.account()
            storm.figures.seconds = time.monotonic() - begun
    return storm


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the long form; return 1 where something was that must not be."""
    parser = argparse.ArgumentParser(description="A plant of three hosts, and all that can happen")
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--short", action="store_true", help="each fault once, and shortly")
    options = parser.parse_args(arguments)

    def say(text: str) -> None:
        print(text, flush=True)  # noqa: T201

    say(f"seed {options.seed}")
    seconds = None if options.short else options.seconds
    try:
        with hosts(HUB, options.seed) as switch:
            storm = asyncio.run(
                storm_over(
                    switch, cameras=options.cameras, seed=options.seed, seconds=seconds, say=say
                )
            )
    except NoNamespacesError as error:
        say(str(error))
        return 2
    say(storm.report())
    return 1 if storm.figures.violations else 0


if __name__ == "__main__":
    sys.exit(main())
