"""Counts what each parser takes for a byte, and how that grows: ``python -m tests.budgets``.

::

    python -m tests.budgets [PARSER ...] [--processes N] [--worst] [--write]

Each input is read in callgrind (valgrind), which counts the processor's instructions; memory is
counted without it. A line is printed for each parser; what grows by more than the input, or takes
more than its budget, is told, and the exit code is 1. ``--write`` puts budgets of three times the
instructions and twice the memory that were counted into ``results/budgets.md``.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tests import ROOT
from tests.budgets import counting
from tests.budgets.table import EXAMPLE, FREE, PAGE, PARSERS, Budget, budgets, row

NEGLIGIBLE = 200_000
"""Instructions of a doubling below which it is no growth: a list gets room, a collector runs."""


def child(written: Path, names: list[str]) -> None:
    """Count in callgrind; print a line of JSON for each input.

    Args:
        written: what callgrind's files are called.
        names: of parsers; behind a tabulator stands the one kind of input that is counted, small.
    """
    count = counting.Instructions(written)
    for said in names:
        name, _, only = said.partition("\t")
        parser = EXAMPLE if name == EXAMPLE.name else PARSERS[name]
        kinds = [only] if only else list(parser.inputs)
        for kind in kinds:
            size = min(parser.size, parser.short) if only else parser.start(kind)
            grown = counting.grow(parser, parser.inputs[kind], count, size)
            print(json.dumps([name, kind, grown.sizes, grown.counts]), flush=True)


def count_instructions(
    names: list[str], *, worst: bool = False
) -> dict[str, dict[str, counting.Growth]]:
    """Return the growth of each input of some parsers, counted in a process of its own.

    ``worst``: of each parser only the input that takes most lines of Python, and small ones.

    Raises:
        RuntimeError: the process failed.
    """
    asked = [f"{one}\t{counting.costliest(PARSERS[one])}" for one in names] if worst else names
    with tempfile.TemporaryDirectory(prefix="budgets-") as folder:
        written = Path(folder) / "counts"
        command = [
            *counting.CALLGRIND,
            f"--callgrind-out-file={written}",
            *(sys.executable, "-m", "tests.budgets", "--child", str(written), *asked),
        ]
        done = subprocess.run(  # noqa: S603 - this very file
            command,
            cwd=ROOT,
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1"},
            check=False,
        )
    found: dict[str, dict[str, counting.Growth]] = {}
    for line in done.stdout.splitlines():
        name, kind, sizes, counts = json.loads(line)
        found.setdefault(name, {})[kind] = counting.Growth(tuple(sizes), tuple(counts))
    if done.returncode:
        raise RuntimeError(f"{' '.join(names)}: exit code {done.returncode}\n{done.stderr[-3000:]}")
    return found


def wrong(name: str, kind: str, grown: counting.Growth, budget: Budget | None) -> list[str]:
    """Return what is wrong with the instructions of an input."""
    found = []
    if grown.is_faster and grown.added > NEGLIGIBLE:
        found.append(
            f"{name}: {kind}: the second doubling adds {grown.factor:.2f} times as many "
            f"instructions as the first: {grown.counts} for {grown.sizes} bytes"
        )
    if budget is not None and grown.per_byte > budget.instructions:
        found.append(
            f"{name}: {kind}: {grown.per_byte:,.0f} instructions a byte, the budget is "
            f"{budget.instructions:,}"
        )
    return found


def _rounded(value: float) -> int:
    """Return a number of two digits, none less."""
    digits = max(0, len(str(int(value))) - 2)
    unit = int(f"1{'0' * digits}")
    return max(1, -(-int(value + 1) // unit) * unit)


def report(names: list[str], processes: int, *, write: bool, worst: bool) -> bool:
    """Count, print a line for each parser; return whether all is well."""
    shares = [names[at::processes] for at in range(processes)]
    with ThreadPoolExecutor(processes) as pool:
        grown = {
            name: one
            for some in pool.map(
                functools.partial(count_instructions, worst=worst), filter(None, shares)
            )
            for name, one in some.items()
        }
    known = {} if write else budgets()
    rows, complaints = {}, []
    print(f"{'parser':34}{'inputs':>7}{'growth':>8}{'instr/byte':>12}{'memory/byte':>12}  worst")
    for name in names:
        parser, inputs = PARSERS[name], grown[name]
        memory = max(memory_of(name).values())
        kind = max(inputs, key=lambda one: inputs[one].per_byte)
        cost = inputs[kind].per_byte
        growth = max((one.factor for one in inputs.values() if one.added > NEGLIGIBLE), default=0.0)
        print(
            f"{name:34}{len(inputs):>7}{growth:>8.2f}{cost:>12,.0f}{memory:>12,.1f}  {kind}",
            flush=True,
        )
        rows[name] = row(parser, _rounded(3 * cost), _rounded(2 * memory))
        for one, told in inputs.items():
            complaints += wrong(name, one, told, known.get(name))
        if name in known and memory > known[name].memory:
            complaints.append(f"{name}: {memory:,.1f} bytes of memory a byte")
    if write:
        _write(rows)
    print("\n".join(complaints) or "all within their budgets")
    return not complaints


def memory_of(name: str) -> dict[str, float]:
    """Return the bytes of memory that a parser takes for each byte that an input has more.

    Raises:
        AssertionError: it takes more than :data:`FREE` whatever it is given.
    """
    parser = PARSERS[name]
    found = {}
    for kind, make in parser.inputs.items():
        grown = counting.grow(parser, make, counting.memory, parser.start(kind))
        found[kind] = max(0.0, grown.per_byte)
        free = grown.counts[2] - grown.per_byte * grown.sizes[2]
        assert free <= FREE, f"{name}: {kind}: {free:,.0f} bytes of memory for nothing"
    return found


def _write(rows: dict[str, str]) -> None:
    text = PAGE.read_text(encoding="utf-8")
    for name, line in rows.items():
        pattern = rf"(?m)^\| {re.escape(name)} \|.*$"
        if re.search(pattern, text):
            text = re.sub(pattern, line.replace("\\", r"\\"), text)
        else:
            text = f"{text.rstrip()}\n{line}\n"
    PAGE.write_text(text, encoding="utf-8")


def main(arguments: list[str]) -> int:
    """Run the command."""
    if arguments[:1] == ["--child"]:
        child(Path(arguments[1]), arguments[2:])
        return 0
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("parsers", nargs="*", metavar="PARSER", help="default: all of them")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--worst", action="store_true", help="of each parser the worst input only")
    parser.add_argument("--write", action="store_true", help=f"write them into {PAGE.name}")
    options: Any = parser.parse_args(arguments)
    if shutil.which("valgrind") is None:
        parser.error("valgrind is not installed: apt-get install valgrind")
    unknown = [one for one in options.parsers if one not in PARSERS]
    if unknown:
        parser.error(f"no parser {unknown[0]!r}; there are {', '.join(PARSERS)}")
    names = [one for one in options.parsers or PARSERS if not PARSERS[one].missing]
    return 0 if report(names, options.processes, write=options.write, worst=options.worst) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
