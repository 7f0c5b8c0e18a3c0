"""Fuzzing with coverage: atheris and libFuzzer run the targets, one after the other.

::

    python -m tests.fuzz [TARGET ...] [--runs N] [--seconds T] [--seed S] [--keep]
    python -m tests.fuzz --reproduce TARGET HEX

Each target runs in a process of its own, from the seeds of ``fuzz_seeds.py`` and the corpus. A
finding ends its target; it is printed as hex, and the exit code is 1. Reproducing needs no atheris.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tests import ROOT

if TYPE_CHECKING:
    # not imported here: what it brings of smartcam would not be instrumented any more
    from tests.fuzz.fuzz_targets import Target

CHILD = (sys.executable, "-W", "error", "-m", "tests.fuzz", "--child")
"""The command of a target's process; its name follows."""

TIMEOUT = 10
"""Seconds that one input may take."""

MEMORY = 768
"""Mebibytes that a target's process may have resident."""

START_TIME = 120
"""Seconds that a process gets beside ``--seconds``: to import, to read the corpus, to end."""

MERGE_TIME = 600
"""Seconds that making a corpus small may take."""


class Outcome(NamedTuple):
    """The outcome of a run of one target."""

    executions: int
    seconds: float
    edges: int
    features: int
    fresh: int
    findings: list[Path]
    code: int
    log: str

    @property
    def good(self) -> bool:
        """True if the run came to its end, found nothing, and saw which code was reached."""
        return self.code == 0 and not self.findings and self.edges > 0


# ---------------------------------------------------------------------- the target's process


def child(target: str, arguments: list[str]) -> None:
    """Become libFuzzer for one target; does not return."""
    atheris: Any = importlib.import_module("atheris")
    with atheris.instrument_imports(include=["smartcam"], enable_loader_override=False):
        check = _load(target)
    limit_memory()
    # libFuzzer starts processes of its own when it merges, by a shell and this "program's name"
    program = shlex.join([*CHILD, target])
    atheris.Setup([program, *arguments], past_known(target, check))
    atheris.Fuzz()


def limit_memory() -> None:
    """Let the process have :data:`MEMORY` more than it has; libFuzzer looks once a second only."""
    resource: Any = importlib.import_module("resource")
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + (MEMORY << 20)
    _, bound = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (most, bound))


def past_known(name: str, check: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """Return ``check`` without the findings that are known."""
    known: Callable[[str, BaseException], object] = importlib.import_module(
        "tests.fuzz.fuzz_targets"
    ).known

    def check_past_known(data: bytes) -> None:
        try:
            check(data)
        except Exception as error:
            if known(name, error) is None:
                raise

    return check_past_known


def _load(name: str) -> Callable[[bytes], None]:
    return _targets()[name].load()


def _targets() -> dict[str, Target]:
    targets: dict[str, Target] = importlib.import_module("tests.fuzz.fuzz_targets").TARGETS
    return targets


# ---------------------------------------------------------------------- the runner


def run(target: Target, runs: int, options: argparse.Namespace) -> Outcome:
    """Fuzz one target, ``runs`` times at most where that is not 0."""
    with tempfile.TemporaryDirectory(prefix=f"fuzz-{target.name}-") as scratch:
        folder = Path(scratch)
        found = _folder(folder / "new")
        known = [*_corpus_folders(target, folder)]
        limits = [f"-runs={runs}"] if runs else []
        limits += [f"-max_total_time={options.seconds}"] if options.seconds else []
        wait = START_TIME + (options.seconds or runs * TIMEOUT)
        began = time.monotonic()
        log, code = _libfuzzer(
            target, folder, [*limits, f"-seed={options.seed}", str(found), *known], wait
        )
        seconds = time.monotonic() - began
        edges, features = _last(r"cov: (\d+) ft: (\d+)", log) or (0, 0)
        (executions,) = _last(r"stat::number_of_executed_units: (\d+)", log) or (0,)
        findings = _keep_findings(folder / "findings", Path(options.findings))
        fresh = len(list(found.iterdir()))
        if options.keep:
            fresh = keep(target, folder, [str(found), *known])
        return Outcome(executions, seconds, edges, features, fresh, findings, code, log)


def keep(target: Target, folder: Path, sources: list[str]) -> int:
    """Put the smallest inputs that reach everything into the corpus; return how many are new."""
    merged = _folder(folder / "merged")
    merge = ["-set_cover_merge=1", str(merged), *sources]
    log, code = _libfuzzer(target, folder, merge, MERGE_TIME)
    if code or not any(merged.iterdir()):
        raise RuntimeError(f"{target.name}: the corpus could not be merged:\n{log[-3000:]}")
    before = target.reached()
    kept = {_digest(path.read_bytes()): path.read_bytes() for path in merged.iterdir()}
    target.keep(kept)  # findings stay what they are
    return len(set(kept) - set(before))


def _corpus_folders(target: Target, folder: Path) -> Iterator[str]:
    seeds: list[bytes] = importlib.import_module("tests.fuzz.fuzz_seeds").seeds(target.name)
    own = _folder(folder / "seeds")
    for data in (*seeds, *target.inputs().values()):
        (own / _digest(data)).write_bytes(data)
    yield str(own)


def _libfuzzer(
    target: Target, folder: Path, arguments: Sequence[str], wait: float
) -> tuple[str, int]:
    """Run libFuzzer on a target; return what it printed and its exit code."""
    dictionary = folder / "words.dict"
    dictionary.write_text("".join(f'"{_escaped(word)}"\n' for word in target.words))
    findings = _folder(folder / "findings")
    command = [*CHILD, target.name]
    command += [
        f"-max_len={target.max_length}",
        f"-timeout={TIMEOUT}",
        f"-rss_limit_mb={MEMORY}",
        f"-dict={dictionary}",
        f"-artifact_prefix={findings}/",
        "-print_final_stats=1",
        *arguments,
    ]
    path = folder / "log"
    with path.open("wb") as log:
        done = subprocess.run(  # noqa: S603 - this very file
            command,
            cwd=ROOT,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONHASHSEED": "0", "TMPDIR": str(folder)},
            timeout=wait,
            check=False,
        )
    return path.read_text(encoding="utf-8", errors="replace"), done.returncode


def _escaped(word: bytes) -> str:
    return "".join(f"\\x{byte:02x}" for byte in word)


def _keep_findings(found: Path, folder: Path) -> list[Path]:
    """Take the findings out of the scratch folder; return where they are."""
    kept: list[Path] = []
    for path in sorted(found.iterdir()):
        if path.name.startswith("slow-unit"):
            continue
        data = path.read_bytes()
        kind = path.name.partition("-")[0]
        kept.append(_folder(folder) / f"{kind}-{_digest(data)}")
        kept[-1].write_bytes(data)
    return kept


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:10]


def _last(pattern: str, log: str) -> tuple[int, ...] | None:
    found = re.findall(pattern, log)
    if not found:
        return None
    last = found[-1]
    return tuple(map(int, last if isinstance(last, tuple) else (last,)))


def report(target: Target, outcome: Outcome) -> None:
    """Print one target's line, and what was found."""
    rate = outcome.executions / outcome.seconds
    print(
        f"{target.name:13}{outcome.executions:>12,}{outcome.seconds:>9.1f}{rate:>10,.0f}"
        f"{outcome.edges:>8}{outcome.features:>10}{outcome.fresh:>6}{len(outcome.findings):>10}",
        flush=True,
    )
    for path in outcome.findings:
        shown = re.search(
            r"(?m)^ ?=+ Uncaught Python exception.*?(?=^==\d+==)", outcome.log, re.DOTALL
        )
        print(f"\n{path.name}\n{shown[0] if shown else outcome.log[-3000:]}")
        print(f"python -m tests.fuzz --reproduce {target.name} {path.read_bytes().hex()}\n")
    if outcome.code and not outcome.findings:
        print(f"\n{outcome.log[-3000:]}\n{target.name} ended with exit code {outcome.code}")
    elif not outcome.edges:
        print(f"{target.name}: smartcam was not instrumented, so inputs were changed blindly")


def main(arguments: list[str]) -> int:
    """Run the command."""
    if arguments[:1] == ["--child"]:
        child(arguments[1], arguments[2:])
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="default: all of them")
    parser.add_argument("--runs", type=int, default=0, help="executions of all of them together")
    parser.add_argument("--seconds", type=int, default=0, help="time for each target")
    parser.add_argument("--seed", type=int, default=1, help="of the mutations, not 0")
    parser.add_argument("--keep", action="store_true", help="take what reaches more into corpus/")
    parser.add_argument("--findings", default=".", help="folder for the inputs that failed")
    parser.add_argument("--reproduce", nargs=2, metavar=("TARGET", "HEX"), help="run one input")
    options = parser.parse_args(arguments)
    if options.reproduce:
        warnings.simplefilter("error")
        name, data = options.reproduce
        _load(name)(bytes.fromhex(data))
        print("nothing found")
        return 0
    targets = _targets()
    unknown = [name for name in options.targets if name not in targets]
    if unknown:
        parser.error(f"no target {unknown[0]!r}; there are {', '.join(targets)}")
    if not options.runs and not options.seconds:
        parser.error("say how long: --runs or --seconds")
    print(
        f"{'target':13}{'executions':>12}{'seconds':>9}{'per s':>10}"
        f"{'edges':>8}{'features':>10}{'new':>6}{'findings':>10}"
    )
    chosen = [targets[name] for name in options.targets or targets]
    shares = sum(target.share for target in chosen)
    good = True
    for target in chosen:
        outcome = run(target, -(-options.runs * target.share // shares), options)
        report(target, outcome)
        good = good and outcome.good
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
