"""Prints the type hashes that ROS' own generator gives to the interfaces of packages.

ROS' sources are needed, in one folder: github.com/ros2/rosidl, ros2/common_interfaces and
ros2/rcl_interfaces, and ``lark`` and ``empy<4``::

    python tests/ros2/rosidl_hashes.py FOLDER ros2/smartcam_msgs > hashes.json

What it prints goes into ``golden/hashes.json``, with the commit of rosidl.
"""

from __future__ import annotations

import importlib
import json
import sys
import tempfile
from pathlib import Path

NEEDED = ("builtin_interfaces", "service_msgs", "std_msgs", "geometry_msgs", "sensor_msgs")
PARTS = ("rosidl_adapter", "rosidl_parser", "rosidl_generator_type_description", "rosidl_cli")


def hashes_of(sources: Path, packages: list[Path], out: Path) -> dict[str, str]:
    """Return the hashes of all interfaces of packages, which may need each other in this order."""
    sys.path += [str(next(sources.rglob(f"{part}/package.xml")).parent) for part in PARTS]
    adapter = importlib.import_module("rosidl_adapter")
    generator = importlib.import_module("rosidl_generator_type_description")
    needed = [next(sources.rglob(f"{name}/package.xml")).parent for name in NEEDED]
    hashes: dict[str, str] = {}
    for package in (*needed, *packages):
        name, made = package.name, out / package.name
        files = sorted([*package.glob("msg/*.msg"), *package.glob("srv/*.srv")])
        idl = [
            adapter.convert_to_idl(package, name, one.relative_to(package), made) for one in files
        ]
        arguments = out / f"{name}.json"
        said = {
            "package_name": name,
            "output_dir": str(made),
            "idl_tuples": [f"{made}:{one.relative_to(made)}" for one in idl],
            "include_paths": [f"{one.name}:{out / one.name}" for one in (*needed, *packages)],
        }
        arguments.write_text(json.dumps(said))
        for file in generator.generate_type_hash(str(arguments)):
            described = json.loads(Path(file).read_text())
            found = {one["type_name"]: one["hash_string"] for one in described["type_hashes"]}
            hashes |= {one: text for one, text in found.items() if one.startswith(f"{name}/")}
    return hashes


def main() -> None:
    """Print the hashes of the packages that are named."""
    sources, *packages = (Path(one).resolve() for one in sys.argv[1:])
    told, sys.stdout = sys.stdout, sys.stderr  # the generator prints what it does
    with tempfile.TemporaryDirectory() as folder:
        hashes = hashes_of(sources, packages, Path(folder))
    names = {one.name for one in packages}
    ours = {one: text for one, text in sorted(hashes.items()) if one.partition("/")[0] in names}
    print(json.dumps(ours, indent=1), file=told)


if __name__ == "__main__":
    main()
