"""Small texts of YAML that stand for much."""

from __future__ import annotations


def laughs(levels: int) -> str:
    """Return lists of ten of the one before."""
    rows = [
        f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]" for level in range(1, levels)
    ]
    return "\n".join(["a0: &a0 [1, 2]", *rows])


def merges(levels: int) -> str:
    """Return mappings, each merged of the one before, twice."""
    rows = [
        f"m{level}: &m{level}\n  <<: [*m{level - 1}, *m{level - 1}]\n  k{level}: 1"
        for level in range(1, levels)
    ]
    return "\n".join(["m0: &m0 {x: 1}", *rows])
