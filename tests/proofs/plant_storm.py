"""A plant of several hosts to which everything happens that can: whose result is whose, and where?

Three hosts are network namespaces with a switch between them, and a router on a fourth. Each has
a process with emulated cameras, an agent for them, and a program that reads the results of all
cameras and triggers one after the other. On a fifth are cameras that the first two agents can
reach: they stand by for each other. Faults come by a seeded plan, one or two at a time: an agent
killed, alone or with a program that has a camera reserved; the router killed; a cable cut, for a
minute, too; a host without the router, and somebody who comes to it then; loss; delay; a program or
the cameras stopped; a disk filled; a certificate that has expired or is renewed; a second agent of
one name; a camera that a reload renames; strangers at the router's port. Where faketime is
installed, the clocks of two hosts are an hour off.

Each trigger brings a number of its own, which its result has; each run of a camera has one, too. So
a block of a reservation that ends without an error shows whether anybody came between.

Who is there is ``plant_site.py`` with ``plant_hosts.py`` and ``plant_process.py``, what happens
``plant_faults.py``, and who judges ``plant_judge.py`` with ``plant_pair.py`` and ``plant_pace.py``.

Long form: ``python -m tests.proofs.plant_storm --seconds 600 --seed 1`` (needs the rights to make
namespaces; prints its figures, exit 1 on a violation).
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

from tests.fleet.fleetkit import PATIENCE
from tests.proofs.plant_faults import SEEN, SHORT, Happening, by_chance
from tests.proofs.plant_hosts import LINE, SITES, NoNamespacesError, Switch, hosts
from tests.proofs.plant_judge import Storm
from tests.proofs.plant_pace import Limit
from tests.proofs.plant_pair import PAIRED, PairWatch
from tests.proofs.plant_site import Site

QUIET = 1.0
"""Seconds between two rounds."""

TIMES_QUIET = 4
"""Such pauses, of which one is to be without a new session."""

TAKEN_OVER = 1.0
"""Seconds of work from the end of an agent until who stands by has what it had."""


async def weather(site: Site, happening: Sequence[Happening]) -> None:
    """Have faults happen together; presence is right within the lease after the last."""
    storm = site.storm
    what = ", ".join(map(str, happening))
    watch = PairWatch(site.pair, storm, happening, site.told)
    await asyncio.gather(
        *(one.fault.act(site, one.host, one.seconds) for one in happening),
        *(taken_over(site, watch, camera) for camera in PAIRED),
    )
    for one in happening:
        storm.done[one.name] += 1
    took = await site.all_here(SEEN)
    if took is None:
        storm.complain(f"{what}: not right {SEEN.seconds:g} s later: {site.missing()}")
        more = await site.all_here(Limit(PATIENCE))
        took = SEEN.seconds + (PATIENCE if more is None else more)
        storm.notes.append(f"{what}: presence was right after {took:.1f} s")
    for one in happening:
        storm.right[one.name].append(took)
    watch.judge(site.told)
    for _ in range(TIMES_QUIET):  # a session that the last fault ended may be made anew yet
        sessions = site.pair.sessions.copy()
        await asyncio.sleep(QUIET)
        if site.pair.sessions == sessions:
            break
    else:
        storm.complain(f"{what}: cameras of the pair have new sessions when all is well again")


async def taken_over(site: Site, watch: PairWatch, camera: str) -> None:
    """Complain unless a standby agent has the camera of the pair as soon as its agent is gone."""
    found = watch.successor(camera)
    if found is None:
        return
    host, one = found
    limit = Limit(TAKEN_OVER, one.gone or 0.0)
    took = await site.until(lambda: watch.has_taken(host, camera), limit)
    if took is None:
        site.storm.complain(f"{one}: {camera} is not host {host}'s {limit.seconds:g} s later")
    else:
        site.storm.taken_over[one.name].append(took)


async def storm_over(
    switch: Switch, *, cameras: int, seed: int, seconds: float | None, say: Callable[[str], None]
) -> Storm:
    """Have a storm over a plant; without ``seconds`` the short form's."""
    storm = Storm()
    chance = Random(f"{seed} plan")  # noqa: S311
    with tempfile.TemporaryDirectory() as folder:
        async with Site(storm, switch, Path(folder), -(-cameras // len(SITES)), seed) as site:
            begun = time.monotonic()

            async def have(happening: Sequence[Happening]) -> None:
                say(f"{time.monotonic() - begun:6.1f} s  {', '.join(map(str, happening))}")
                await weather(site, happening)

            if seconds is None:
                for happening in SHORT:
                    await have(happening)
            else:
                while time.monotonic() - begun < seconds:
                    await have(by_chance(chance))
            await site.end()
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
        with hosts(LINE, options.seed) as switch:
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
