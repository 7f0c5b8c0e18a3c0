"""The fields of messages and services of ROS' packages, such as vision_msgs and std_srvs."""

from __future__ import annotations

from typing import Final


def _expand_texts(package: str, category: str, short_texts: dict[str, str]) -> dict[str, str]:
    """Return the texts of files from short texts: ``;`` is a new line, ``|`` ends a request."""
    return {
        f"{package}/{category}/{name}": "\n".join(
            "---" if part == "|" else part
            for line in text.replace("|", ";|;").split(";")
            if (part := line.strip())
        )
        for name, text in short_texts.items()
    }


ROS_MESSAGES: Final = _expand_texts(
    "vision_msgs",
    "msg",
    {
        "BoundingBox2D": "Pose2D center; float64 size_x; float64 size_y",
        "BoundingBox2DArray": "std_msgs/Header header; BoundingBox2D[] boxes",
        "BoundingBox3D": "geometry_msgs/Pose center; geometry_msgs/Vector3 size",
        "BoundingBox3DArray": "std_msgs/Header header; BoundingBox3D[] boxes",
        "Classification": "std_msgs/Header header; ObjectHypothesis[] results",
        "Detection2D": "std_msgs/Header header; ObjectHypothesisWithPose[] results;"
        "BoundingBox2D bbox; string id",
        "Detection2DArray": "std_msgs/Header header; Detection2D[] detections",
        "Detection3D": "std_msgs/Header header; ObjectHypothesisWithPose[] results;"
        "BoundingBox3D bbox; string id",
        "Detection3DArray": "std_msgs/Header header; Detection3D[] detections",
        "LabelInfo": "std_msgs/Header header; VisionClass[] class_map; float32 threshold",
        "ObjectHypothesis": "string class_id; float64 score",
        "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis;"
        "geometry_msgs/PoseWithCovariance pose",
        "Point2D": "float64 x; float64 y",
        "Pose2D": "Point2D position; float64 theta",
        "VisionClass": "uint16 class_id; string class_name",
        "VisionInfo": "std_msgs/Header header; string method; string database_location;"
        "int32 database_version",
    },
)

ROS_SERVICES: Final = {
    **_expand_texts(
        "std_srvs",
        "srv",
        {
            "Empty": "|",
            "SetBool": "bool data | bool success; string message",
            "Trigger": "| bool success; string message",
        },
    ),
    **_expand_texts(
        "lifecycle_msgs",
        "srv",
        {
            "ChangeState": "Transition transition | bool success",
            "GetAvailableStates": "| State[] available_states",
            "GetAvailableTransitions": "| TransitionDescription[] available_transitions",
            "GetState": "| State current_state",
        },
    ),
    **_expand_texts(
        "rcl_interfaces",
        "srv",
        {
            "DescribeParameters": "string[] names | ParameterDescriptor[] descriptors",
            "GetLoggerLevels": "string[] names | LoggerLevel[] levels",
            "GetParameterTypes": "string[] names | uint8[] types",
            "GetParameters": "string[] names | ParameterValue[] values",
            "ListParameters": "uint64 DEPTH_RECURSIVE=0; string[] prefixes; uint64 depth |"
            "ListParametersResult result",
            "SetLoggerLevels": "LoggerLevel[] levels | SetLoggerLevelsResult[] results",
            "SetParameters": "Parameter[] parameters | SetParametersResult[] results",
            "SetParametersAtomically": "Parameter[] parameters | SetParametersResult result",
        },
    ),
    **_expand_texts(
        "type_description_interfaces",
        "srv",
        {
            "GetTypeDescription": "string type_name; string type_hash;"
            "bool include_type_sources true |"
            "bool successful; string failure_reason; TypeDescription type_description;"
            "TypeSource[] type_sources; KeyValue[] extra_information",
        },
    ),
    **_expand_texts(
        "composition_interfaces",
        "srv",
        {
            "ListNodes": "| string[] full_node_names; uint64[] unique_ids",
            "LoadNode": "string package_name; string plugin_name; string node_name;"
            "string node_namespace; uint8 log_level; string[] remap_rules;"
            "rcl_interfaces/Parameter[] parameters; rcl_interfaces/Parameter[] extra_arguments |"
            "bool success; string error_message; string full_node_name; uint64 unique_id",
            "UnloadNode": "uint64 unique_id | bool success; string error_message",
        },
    ),
    **_expand_texts(
        "diagnostic_msgs",
        "srv",
        {
            "AddDiagnostics": "string load_namespace | bool success; string message",
            "SelfTest": "| string id; byte passed; DiagnosticStatus[] status",
        },
    ),
    **_expand_texts(
        "sensor_msgs",
        "srv",
        {"SetCameraInfo": "CameraInfo camera_info | bool success; string status_message"},
    ),
    **_expand_texts(
        "example_interfaces",
        "srv",
        {"AddTwoInts": "int64 a; int64 b | int64 sum"},
    ),
}
