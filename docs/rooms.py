"""The drawing of the rooms in ``docs/architecture``, made from the imports in the code.

``python docs/rooms.py`` writes it anew; ``tests/test_docs.py`` fails where it is not what the code
says. Where a room stands is chosen here, its arrows are not.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
DRAWING = Path(__file__).parent / "architecture" / "rooms.svg"


class Room(NamedTuple):
    """A box: its title, what it is for, and where it stands (column and row, from 0)."""

    title: str
    purpose: str
    column: float
    row: int
    modules: tuple[str, ...] = ()

    def holds(self, module: str) -> bool:
        """Whether a module or package right below smartcam is drawn as this box."""
        return module in (self.modules or (self.title,))


VALUES = (
    "models",
    "exceptions",
    "settings",
    "_settings_model",
    "registry",
    "streams",
    "observers",
    "backoff",
)
HELPERS = (
    *(
        "_accepting",
        "_argument_checks",
        "_arguments",
        "_datagrams",
        "_extras",
        "_file_values",
        "_forks",
        "_html",
        "_finishing",
        "_json",
        "_lazy",
        "_locks",
        "_loop_thread",
        "_meanings",
        "_natural",
        "_ros_names",
        "_server",
        "_switch_interval",
        "_suggestions",
        "_user_code",
        "_whole_files",
    ),
    "_zenoh",
)
ROOMS = (
    Room("_cli", "the two commands", 1, 0, ("_cli", "__main__")),
    Room("testing", "for others' tests", 3, 0, ("testing", "pytest_plugin")),
    Room("web", "pages in a browser", 0, 2),
    Room("recording", "files of what came", 2, 1, ("recording", "_dissector")),
    Room("conformance", "judges", 3, 1),
    Room("calibration", "camera to robot", 0, 9),
    Room("doctor", "what is wrong", 1, 2),
    Room("ros1", "cameras in ROS 1", 3, 2),
    Room("connecting", "from a URL to a camera", 2, 3, ("connecting", "sync", "_sync_base")),
    Room("fleet", "cameras, shared", 2, 4),
    Room("depth", "metres and clouds", 0.5, 4),
    Room("gateway", "lines to robots", 3, 4),
    Room("ros2", "cameras in ROS 2", 2, 5),
    Room("outlets", "brokers, databases", 3, 5),
    Room("inspection", "pictures to values", 0, 5),
    Room("makes", "ifm, Keyence", 3, 6),
    Room("frames", "pictures of any camera", 1, 6),
    Room(
        "client",
        "what a program uses",
        1.5,
        7,
        ("camera", "client", "_thesis", "_thesis_calibration"),
    ),
    Room("emulator", "cameras without one", 3, 7),
    Room("_client", "how a client works", 1.5, 8),
    Room("interpreters", "payload to value", 1, 9),
    Room("protocols", "bytes to messages", 3, 9),
    Room("geometry", "motions and lenses", 0, 10),
    Room("layout", "what a payload holds", 1.5, 10),
    Room("values", "models, errors, settings", 2, 11, VALUES + HELPERS),
)
STEP = (190, 84)
SIZE = (150, 46)
MARGIN = 20


def imports() -> set[tuple[str, str]]:
    """Return which room imports which when it runs, without what follows from the others."""
    found: dict[str, set[str]] = {room.title: set() for room in ROOMS}
    for path in sorted((ROOT / "smartcam").rglob("*.py")):
        module = path.relative_to(ROOT / "smartcam").parts[0].removesuffix(".py")
        if module != "__init__":
            tree = ast.parse(path.read_text(encoding="utf-8"))
            found[_room(module)].update(map(_room, _imported(tree)))
    return {
        (room, other)
        for room, others in found.items()
        for other in others - {room}
        if not any(_reaches(found, one, other) for one in others - {room, other})
    }


def _room(module: str) -> str:
    """Return the title of the box for a module, or for a name that smartcam itself exports."""
    for room in ROOMS:
        if room.holds(module):
            return room.title
    if any((ROOT / "smartcam").glob(f"{module}*")):
        raise LookupError(f"smartcam/{module} is in no room of the drawing")
    named = {"Camera": "client", "SmartCamera": "client", "connect": "connecting"}
    return named.get(module, "values")


def _imported(tree: ast.AST) -> set[str]:
    """Return the modules right below smartcam that are imported, those for types left out."""
    found: set[str] = set()
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.ImportFrom) and node.module == "smartcam":
            found.update(one.name for one in node.names)
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
            found.update(name.split(".")[1] for name in names if name.startswith("smartcam."))
        elif isinstance(node, ast.Import):
            names = [one.name for one in node.names]
            found.update(name.split(".")[1] for name in names if name.startswith("smartcam."))
        found |= _imported(node)
    return found


def _reaches(found: dict[str, set[str]], start: str, end: str) -> bool:
    seen, left = {start}, [start]
    while left:
        following = found[left.pop()] - seen
        seen |= following
        left += following
    return end in seen


def drawing() -> str:
    """Return the drawing as SVG."""
    wide, high = SIZE
    places = {
        one.title: (MARGIN + one.column * STEP[0], MARGIN + one.row * STEP[1]) for one in ROOMS
    }
    width = max(x for x, _ in places.values()) + wide + MARGIN
    height = max(y for _, y in places.values()) + high + MARGIN
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        'font-family="sans-serif" font-size="12" text-anchor="middle">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" '
        'markerHeight="8" orient="auto"><path d="M0 0 8 4 0 8z" fill="#567"/></marker></defs>',
        f'<rect width="{width:g}" height="{height:g}" fill="#fff"/>',
    ]
    for room, other in sorted(imports()):
        (x, y), (to_x, to_y) = places[room], places[other]
        begin, end, bend = (x + wide / 2, y + high), (to_x + wide / 2, to_y), STEP[1] - high
        if y == to_y:  # neighbours
            side = wide if x < to_x else 0
            begin, end = (x + side, y + high / 2), (to_x + wide - side, to_y + high / 2)
            bend = 0
        lines.append(
            f'<path d="M{begin[0]:g} {begin[1]:g}C{begin[0]:g} {begin[1] + bend:g} '
            f'{end[0]:g} {end[1] - bend:g} {end[0]:g} {end[1]:g}" '
            'fill="none" stroke="#567" marker-end="url(#tip)"/>'
        )
    for room in ROOMS:
        x, y = places[room.title]
        lines += [
            f'<rect x="{x:g}" y="{y:g}" width="{wide}" height="{high}" rx="4" '
            'fill="#eef4fa" stroke="#567"/>',
            f'<text x="{x + wide / 2:g}" y="{y + 19:g}" font-weight="bold">{room.title}</text>',
            f'<text x="{x + wide / 2:g}" y="{y + 36:g}" fill="#456">{room.purpose}</text>',
        ]
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    DRAWING.write_text(drawing(), encoding="utf-8")
