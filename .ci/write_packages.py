"""Write packages of ROS that have no wheels, with the fields that smartcam knows, into a folder."""

import re
import sys
from pathlib import Path

from smartcam.ros2 import RosTypes

TYPES = ("tf2_msgs/msg/TFMessage", "vision_msgs/msg/Detection3DArray")
CMAKE = """\
cmake_minimum_required(VERSION 3.8)
project({package})
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(std_msgs REQUIRED)
rosidl_generate_interfaces({package} {files} DEPENDENCIES geometry_msgs std_msgs)
ament_package()
"""
MANIFEST = """\
<package format="3">
  <name>{package}</name>
  <version>0.0.0</version>
  <description>The messages that tests need.</description>
  <maintainer email="maintainers@smartcam.example">The smartcam maintainers</maintainer>
  <license>MIT</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend>
  <depend>std_msgs</depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""
types = RosTypes()
for name in TYPES:
    package = name.partition("/")[0]
    folder = Path(sys.argv[1], package)
    (folder / "msg").mkdir(parents=True, exist_ok=True)
    own, *others = re.split(r"^=+\nMSG: (.+)\n", types.message(name).text, flags=re.MULTILINE)
    texts = {name.replace("/msg/", "/"): own, **dict(zip(others[::2], others[1::2], strict=True))}
    files = []
    for full, text in texts.items():
        of, _, short = full.partition("/")
        if of == package:
            files.append(f"msg/{short}.msg")
            (folder / files[-1]).write_text(text)
    (folder / "CMakeLists.txt").write_text(CMAKE.format(package=package, files=" ".join(files)))
    (folder / "package.xml").write_text(MANIFEST.format(package=package))
