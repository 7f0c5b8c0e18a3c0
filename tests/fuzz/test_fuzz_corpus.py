"""The short form of fuzzing: every input of the corpora and some thousand changed ones.

Needs no atheris. Inputs that are named, not numbered, were findings once.
"""

from __future__ import annotations

import random
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from itertools import islice
from typing import Any

import pytest

from smartcam.emulator._inside import Device
from smartcam.inspection._inside import Teaching
from smartcam.interpreters._inside import LocalizationsInterpreter
from smartcam.layout import Layout
from smartcam.protocols import FramedDialect, LineMachine, Machine
from smartcam.protocols._inside import Framer
from smartcam.settings import Address
from tests import ROOT
from tests.fuzz.fuzz_seeds import seeds
from tests.fuzz.fuzz_targets import CORPUS, FINDINGS, KNOWN, TARGETS, Target, describe, known
from tests.inspection import fuzz_cells
from tests.layout.mistakes import CUTS_TEXTS, cannot_tell_lines

SEED = 20_240_229
CHANGED = {"cell_file": 40, "scenario": 60, "layout_file": 60, "camera": 60, "layout": 200}
"""Changed inputs of the slow targets; the others get :data:`MANY`."""
MANY = 700
LARGEST_CORPUS = 300_000

each_target = pytest.mark.parametrize("target", TARGETS.values(), ids=lambda one: one.name)


def row_of(target: str, name: str) -> Any:
    """Return the row of :data:`KNOWN` that an input belongs to, None for another."""
    return next((row for row in KNOWN if row.target == target and name.startswith(row.name)), None)


def run(target: Target, data: bytes, what: str) -> None:
    """Check one input; what is found and not known fails with the input."""
    try:
        target.load()(data)
    except Exception as error:
        if known(target.name, error) is None:
            error.add_note(f"{what}\npython -m tests.fuzz --reproduce {target.name} {data.hex()}")
            raise


def run_corpus(target: Target) -> None:
    for name, data in target.inputs().items():
        run(target, data, name)


@pytest.mark.parametrize(
    "target",
    [  # scenarios take as long as all others
        pytest.param(one, id=one.name, marks=[pytest.mark.long] if one.name == "scenario" else [])
        for one in TARGETS.values()
    ],
)
def test_corpus_gives_no_finding(target: Target) -> None:
    assert target.reached()
    run_corpus(target)


@pytest.mark.sampled(every=2)
@each_target
def test_seeds_give_no_finding(target: Target) -> None:
    first = seeds(target.name)
    assert first
    for data in first:
        run(target, data, "a seed")


@each_target
def test_changed_inputs_give_no_finding(target: Target) -> None:
    inputs = [data for name, data in target.inputs().items() if row_of(target.name, name) is None]
    made = changed([*inputs, *seeds(target.name)], target)
    for number, data in enumerate(islice(made, CHANGED.get(target.name, MANY))):
        run(target, data, f"changed input {number} of seed {SEED}")


def changed(inputs: list[bytes], target: Target) -> Iterator[bytes]:
    """Yield inputs with some bytes changed, cut out, put in or taken from one another."""
    dice = random.Random(f"{SEED} {target.name}")  # noqa: S311 - the same ones always
    words = (*target.words, b"\0", b"\xff", b"\x7f\xff")
    while True:
        data = bytearray(dice.choice(inputs))
        for _ in range(dice.randint(1, 4)):
            at = dice.randint(0, len(data))
            end = dice.randint(at, min(len(data), at + 8))
            other = dice.choice(inputs)
            begin = dice.randint(0, len(other))
            data[at:end] = dice.choice(
                (b"", dice.randbytes(end - at), dice.choice(words), other[begin : begin + 16])
            )
        yield bytes(data[: target.max_length])


# ---------------------------------------------------------------------- what is known


OPEN_FINDINGS = {
    (target.name, name): data
    for target in TARGETS.values()
    for name, data in target.findings().items()
    if row_of(target.name, name) is not None
}


@pytest.mark.long
@pytest.mark.parametrize(("target", "name"), OPEN_FINDINGS, ids="-".join)
def test_known_finding_is_still_there(target: str, name: str) -> None:
    """Fail when the mistake is mended: delete its row of ``KNOWN`` then, and keep the input."""
    with pytest.raises(Exception) as caught:  # noqa: PT011 - the row says which
        TARGETS[target].load()(OPEN_FINDINGS[target, name])
    assert known(target, caught.value) is not None, describe(caught.value)


def test_every_known_finding_has_its_input() -> None:
    assert set(KNOWN) == {row_of(*one) for one in OPEN_FINDINGS}


# ---------------------------------------------------------------------- the net has no holes


def divide_by_zero(*_: object) -> float:
    return 1 / 0


def forget_everything(framer: Framer) -> int:
    skipped = framer.buffered
    framer.clear()
    return skipped


MISTAKES: dict[str, tuple[object, str, Any]] = {
    "framing": (Framer, "resync", forget_everything),
    "messages": (FramedDialect, "surplus", lambda *_: 0),
    "machine": (Machine, "_accept_answer", lambda *_, **__: True),
    "makes": (LineMachine, "_handle_answer_line", divide_by_zero),
    "layout": (Layout, "sequence", lambda *_: None),
    "interpreters": (LocalizationsInterpreter, "_check_numbers", lambda *_: None),
    "scenario": cannot_tell_lines(divide_by_zero),
    "camera": (Device, "_send_changed_status", lambda *_: None),
    "layout_file": (Layout, "to_yaml", lambda _: "x: bool"),
    "address": (Address, "url", property(lambda address: f"bvs://{address.host}")),
    "cell_file": (Teaching, "_check_written", lambda *_: 1 / 0),
    "gs1": (fuzz_cells, "split_elements", fuzz_cells.first_element),
    "program_result": (fuzz_cells.INSPECTOR, "MAX_REASON_BYTES", 90),
    "spec": CUTS_TEXTS,
}
"""A mistake for each target: what is replaced, and by what."""


@each_target
def test_corpus_finds_a_mistake(target: Target, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*MISTAKES[target.name])
    with pytest.raises((AssertionError, ArithmeticError)):
        run_corpus(target)


def test_corpora_are_small_and_belong_to_a_target() -> None:
    paths = [*CORPUS.iterdir()]
    assert {path.stem for path in paths if path != FINDINGS} == set(TARGETS)
    rows = tomllib.loads(FINDINGS.read_text(encoding="utf-8"))["finding"]
    assert {name for row in rows for name in row["targets"]} <= set(TARGETS)
    assert sum(path.stat().st_size for path in paths) < LARGEST_CORPUS


def test_runner_leaves_smartcam_to_be_instrumented() -> None:
    """Code that is imported before atheris looks at it tells nothing of what inputs reach."""
    script = "import sys, tests.fuzz.__main__; sys.exit('smartcam' in sys.modules)"
    subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=True, timeout=60)  # noqa: S603
