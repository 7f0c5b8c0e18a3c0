"""Define the ROS types of the package ``smartcam_msgs``, as its files in ``ros2/`` do."""

from __future__ import annotations

from typing import Final

SMARTCAM_MSGS: Final = {
    "smartcam_msgs/msg/Localization": """\
# One object that a camera found.

string feature_id               # name of the taught feature
float32 quality                 # 0 to 1
int32 photo_index               # number of the photo that shows the object
geometry_msgs/PoseStamped pose  # in metres, in the frame of the pose's header
""",
    "smartcam_msgs/msg/Result": """\
# One result of a camera: its bytes, and the values that they were interpreted as.

std_msgs/Header header           # time of arrival, and the frame of the poses
string camera_name
uint32 application_id            # application on the camera that made the result; 0: unknown
uint64 result_id                 # number of the result of this camera; 0: unknown
string error                     # why the bytes could not be interpreted; empty: no error
Localization[] localizations     # the result, if it consists of localizations
string json                      # any other result, as JSON
uint8[] data                     # the camera's bytes; empty after an error
""",
    "smartcam_msgs/msg/CameraStatus": """\
# State of a camera, sent when it changes.

uint64 OVERHEAT=1                     # allowed temperature exceeded
uint64 SYSTEM_ERROR=2                 # fatal: at least a reboot is needed
uint64 INPUT_CONTAINER=4              # input data and inspections are out of step
uint64 BUSY=16                        # set while the application is being switched
uint64 RUNNING=128                    # in run mode
uint64 OVERTRIGGERED=256              # a trigger was dropped
uint64 WAITING_FOR_TRIGGER=512        # a trigger would be accepted now
uint64 SIMULATION_MODE=34359738368    # the images come from files

std_msgs/Header header
string camera_name
bool connected             # true while there is a session with the camera
bool ready                 # connected, running, not busy and without a fatal error
bool busy                  # the bit BUSY
bool running               # the bit RUNNING
uint32 application_id      # the active application; 0: unknown
uint64 status              # the camera's status word, bits as above; 0: not connected
string[] status_names      # names of the bits that are set, lowest first
string error               # why the camera is not connected, or another error; empty: no error
""",
    "smartcam_msgs/srv/RequestImage": """\
# Takes one picture. It works without a stream of pictures, too.

float64 timeout                      # seconds of the timeout; 0: the default
---
string error                         # empty: success
sensor_msgs/Image image
sensor_msgs/CameraInfo camera_info   # camera info for this image
""",
    "smartcam_msgs/srv/SmartcameraSetup": """\
# Connects a camera; if it is connected with other settings, they are changed.

string camera_name         # unique
string camera_model_name   # such as BVS002C
string port                # network port, or USB port
string con_address         # IP address of a camera in a network
uint32 application_id      # application to load at the start; 0: no switch
string interpret_as        # interpretation of results, such as Localizations or 50ByteStrings
string topic_status        # topic for the status; empty: none
---
string error               # empty: success
""",
    "smartcam_msgs/srv/EnablePublishing": """\
# Publishes the results of a camera on a topic.

string camera_name         # as given at setup
string topic_for_outputs   # topic for the results; empty: stop publishing
float64 min_delay          # shortest time between two results, seconds
uint32 queue_size          # largest number of waiting results; 0: the default
---
string error               # empty: success
""",
    "smartcam_msgs/srv/SmartcameraStop": """\
# Ends publishing and closes the camera.

string camera_name         # as given at setup
---
string error               # empty: success
""",
    "smartcam_msgs/srv/ChangeApplication": """\
# Switches to another application on the camera.

string camera_name         # as given at setup
uint32 application_id      # id of the application
---
string error               # empty: success
""",
    "smartcam_msgs/srv/Trigger50ByteString": """\
# Triggers, and interprets the result as texts of up to 50 bytes.

string camera_name         # as given at setup
uint32 application_id      # application for this trigger only; 0: the active one
float64 timeout            # seconds of the timeout; 0: the default
---
string error               # empty: success
string[] strings
""",
    "smartcam_msgs/srv/TriggerResults": """\
# Triggers, and returns the results in any interpretation.

uint32 application_id       # application for this trigger only; 0: the active one
uint8[] input               # input data for this inspection; empty: none is sent
bool refuse_when_busy       # fail at once if the camera accepts no trigger now
uint32 results_per_trigger  # number of results for each trigger; 0: one
string interpret_as         # interpretation of the results; empty: the camera's setting
float64 timeout             # seconds of the timeout; 0: the default
---
string error                # empty: success
Result[] results
""",
    "smartcam_msgs/srv/TriggerLocalization": """\
# Triggers, and interprets the result as localizations.

string camera_name         # as given at setup
uint32 application_id      # application for this trigger only; 0: the active one
float64 timeout            # seconds of the timeout; 0: the default
---
string error               # empty: success
Localization[] localizations
""",
    "smartcam_msgs/srv/StartCalibration": """\
# Begins a calibration. PerformCurrentAndGetNextStep then returns the first step.

string topic_image1                # topic with the camera's pictures; empty: none
string topic_image2                # second topic with pictures, or SMARTCAMERA: this camera's
float64 checkerboard_squaresize_m  # side of a square of the checkerboard, metres; 0: unknown
string tf_frame_robot_tcp          # TF frame of the tool's tip; empty: poses are entered by hand
string tf_frame_robot_base         # TF frame of the robot's base; empty: root of the tip's tree
string fixed_camera                # True, False (on the flange), or empty: a step asks for it
---
string error                       # empty: success
""",
    "smartcam_msgs/srv/PerformCurrentAndGetNextStep": """\
# Answers the step of the last call, and returns the next step. The first call needs no answers.

bool repeat_last_step   # return to the step before this one
bool abort              # cancel the calibration
float64[] value_inputs  # an answer for each of descriptions_for_needed_values
string[] text_inputs    # an answer for each of descriptions_for_needed_strings
string[] option_inputs  # an answer for each of descriptions_for_needed_options
---
string error            # why the step is repeated; empty: success
string header_text
string description_text
string button_text      # empty at the end
string[] descriptions_for_needed_values
float64[] default_needed_values
string[] descriptions_for_needed_strings
string[] default_needed_strings
string[] descriptions_for_needed_options
string[] default_needed_options  # for each: its default, then all its options, with blanks between
""",
    "smartcam_msgs/srv/ExportCalibration": """\
# Copies a calibration into the subfolder exports of the folder of calibrations.

string calibration_name  # as given in the calibration
string target_path       # name of the file, such as table.json or table.yaml
---
string error             # empty: success
""",
    "smartcam_msgs/srv/LoadCalibration": """\
# Loads a calibration for TransformPixelPose.

string calibration_name_or_path  # name, or exports/NAME.json of an exported calibration
---
string error                     # empty: success
""",
    "smartcam_msgs/srv/TransformPixelPose": """\
# Converts a pose in the camera's plane to a pose of the robot, by the loaded calibration.

std_msgs/Header header     # time and frame of the camera's pose; zeros: unknown
float64 x                  # to the right, in the calibration's unit
float64 y                  # upwards, in the calibration's unit
float64 theta              # counter-clockwise in radians
string tf_frame_reference  # TF frame of the returned pose; empty: the calibration's
---
string error               # empty: success
geometry_msgs/PoseStamped pose
""",
}
"""Texts of the files by name of the type."""
