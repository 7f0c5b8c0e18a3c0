"""Have the cameras of a fleet file as nodes of ROS 2, over the middleware that is set.

``ros2 launch smartcam_bringup cameras.launch.py fleet:=plant.yaml``
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

CONFIG = Path(__file__).resolve().parents[1] / "config"


def generate_launch_description() -> LaunchDescription:
    """Return the one process that has all nodes, and its arguments."""
    arguments = (
        ("fleet", str(CONFIG / "plant.yaml"), "fleet file, or URL of a fleet that is served"),
        ("parameters", str(CONFIG / "parameters.yaml"), "file of parameters of the nodes"),
        ("namespace", "/", "in front of the cameras' names"),
        ("use_sim_time", "false", "whether time is that of the topic /clock"),
    )
    nodes = ExecuteProcess(
        cmd=[
            *("smartcam", "ros2", LaunchConfiguration("fleet"), "--rmw", "native"),
            *("--namespace", LaunchConfiguration("namespace")),
            *("--ros-args", "--params-file", LaunchConfiguration("parameters")),
            *("-p", ["use_sim_time:=", LaunchConfiguration("use_sim_time")]),
        ],
        output="screen",
    )
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in arguments
    ]
    return LaunchDescription([*declared, nodes])
