"""The order of names that hold numbers."""

from __future__ import annotations

from smartcam._natural import natural


def test_numbers_in_names_count() -> None:
    names = ["view10.png", "view2.png", "b1", "view1.png", "7", "view2b.png", "view", "10", "٣"]
    assert sorted(names, key=natural) == [
        *("7", "10", "b1", "view", "view1.png", "view2.png", "view2b.png", "view10.png", "٣"),
    ]
