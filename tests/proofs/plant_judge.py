"""The outcome of a plant: its figures, and the things that must not be."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any

from tests.proofs.chaos_soak import GROWTH, quarters
from tests.proofs.fleet_storm import Figures
from tests.proofs.plant_pace import Pace

WARM_UP = 30
"""Looks at the memory of a process that do not count: it fills its caches."""

MIN_SAMPLES = 30
"""Looks behind those at the memory of a process before it is judged."""


@dataclass
class Storm:
    """The deeds done to a plant, and their outcome.

    Attributes:
        figures: of its calls, and violations.
        pace: of this computer.
        done: faults.
        right: seconds until presence was right again after each.
        moves: how often a camera of the pair went from one agent to the other by each.
        blocks: how blocks of reservations ended.
        taken_over: seconds until who stands by had what the other had, from each on.
        accounts: all programs', summed.
        memory: of each process that was last there under a name, MB.
        notes: what is to be known of the run.
    """

    figures: Figures = field(default_factory=lambda: Figures("plant"))
    pace: Pace = field(default_factory=Pace)
    done: Counter[str] = field(default_factory=Counter)
    right: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    moves: Counter[str] = field(default_factory=Counter)
    blocks: Counter[str] = field(default_factory=Counter)
    taken_over: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    accounts: Counter[str] = field(default_factory=Counter)
    memory: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    notes: list[str] = field(default_factory=list)

    def complain(self, text: str) -> None:
        """Note what must not be."""
        self.figures.violations.append(text)

    def report(self) -> str:
        """Return it as text."""
        figures = self.figures
        lines = [
            f"{figures.seconds:.0f} s, {self.done.total()} faults; {self.pace}",
            *(
                f"  {name}: {count}; presence right after at most "
                f"{max(self.right[name], default=0.0):.1f} s{self._of_pair(name)}"
                for name, count in sorted(self.done.items())
            ),
            f"{figures.calls} calls, {figures.executed} executed: "
            + ", ".join(f"{name} {count}" for name, count in figures.outcomes.most_common()),
            "reserved blocks: "
            + ", ".join(f"{name} {count}" for name, count in self.blocks.most_common()),
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

    def _of_pair(self, name: str) -> str:
        took = self.taken_over[name]
        text = f"; taken over {len(took)} times, after at most {max(took):.1f} s" if took else ""
        moves = self.moves[name]
        return f"{text}; {moves} moves of a camera of the pair" if moves else text

    # ------------------------------------------------------------------ the end

    def judge_account(self, what: str, losses: int, account: Any) -> None:
        """Look whether every result of a camera is in an account of a program's.

        Args:
            what: whose account it is.
            losses: how often results may be in no account: what an agent that was killed had told
                nobody, or what a camera made while no agent had a session. Each is a gap. On a
                computer that has much to do an agent may give a session up, and begin anew.
            account: the program's; None: it has none.
        """
        if account is None:
            self.complain(f"{what} has no account")
            return
        counts = {key: value for key, value in account.items() if isinstance(value, int)}
        for key in ("taken", "dropped", "missed"):
            self.accounts[key] += counts[key]
        if account["again"]:
            self.complain(f"{what}: {account['again']} results came once more: {account}")
        if counts["offered"] != counts["taken"] + counts["dropped"] + counts["queued"]:
            self.complain(f"{what} does not balance: {account}")
        if counts["taken"] != counts["seen"]:
            self.complain(f"{what}: not what it took: {account}")
        gaps = sorted(account["gaps"])
        told = counts["dropped"] + counts["missed"]
        in_accounts = gaps[: max(0, len(gaps) - losses)]
        self.accounts["in no account"] += max(0, sum(gaps) - told)
        before = account["first"] - 1  # some of which may be in the account: it dropped them
        if not losses and told > sum(gaps) + before:
            self.complain(f"{what} has more in its account than it lacks: {account}")
        if sum(in_accounts) > told:
            self.complain(f"{what} lacks results that are in no account: {account}, {losses}")

    def judge_memory(self) -> None:
        """Look whether a process grew."""
        for name, values in self.memory.items():
            warm = values[WARM_UP:]
            if len(warm) < MIN_SAMPLES:
                continue
            first, last = quarters(warm)
            if last > first + GROWTH:
                self.complain(f"{name}: memory grew from {first:.1f} to {last:.1f} MB")
