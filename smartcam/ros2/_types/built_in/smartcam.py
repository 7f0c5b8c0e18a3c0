"""The package ``smartcam_msgs``; ``ros2/smartcam_msgs`` has files with the same texts."""

from __future__ import annotations

from typing import Final

SMARTCAM_MSGS: Final = {
    "smartcam_msgs/msg/Localization": """\
# One object that a camera found.

string feature_id               # name of the taught feature
float32 quality                 # 0 to 1
int32 photo_index               # which photo it was found in
geometry_msgs/PoseStamped pose  # in metres, in the frame that its header names
""",
    "smartcam_msgs/msg/Result": """\
# One result of a camera, as it came and as it was read.

std_msgs/Header header           # when it came, and the frame of its poses
string camera_name
uint32 application_id            # which application on the camera it is from; 0 is not known
uint64 result_id                 # counts the results of this camera; 0 is not known
string error                     # why it could not be read; empty when it could
Localization[] localizations     # what was read, where that is localizations
string json                      # what else was read, as JSON
uint8[] data                     # the camera's bytes; none where it could not be read
""",
    "smartcam_msgs/msg/CameraStatus": """\
# What a camera says of itself, sent when it changes.

uint64 OVERHEAT=1                     # allowed temperature exceeded
uint64 SYSTEM_ERROR=2                 # fatal: at least a reboot is needed
uint64 INPUT_CONTAINER=4              # input data and inspections are out of step
uint64 BUSY=16                        # set while the application is being switched
uint64 RUNNING=128                    # in run mode
uint64 OVERTRIGGERED=256              # a trigger was dropped
uint64 WAITING_FOR_TRIGGER=512        # would take a trigger now
uint64 SIMULATION_MODE=34359738368    # the images come from files

std_msgs/Header header
string camera_name
bool connected             # there is a session with the camera
bool ready                 # connected, running, not busy and without a fatal error
bool busy                  # the bit BUSY
bool running               # the bit RUNNING
uint32 application_id      # the active application; 0 is not known
uint64 status              # the camera's status word, bits as above; 0 where it is not connected
string[] status_names      # names of the bits that are set, lowest first
string error               # why it is not connected, or what else is wrong; empty when all is well
""",
    "smartcam_msgs/srv/RequestImage": """\
# Takes one picture, also of a camera that has no stream of them.

float64 timeout                      # longest wait in seconds; 0 is as usual
---
string error                         # empty when it worked
sensor_msgs/Image image
sensor_msgs/CameraInfo camera_info   # of the same moment
""",
    "smartcam_msgs/srv/SmartcameraSetup": """\
# Connects a camera, or makes sure that it is connected as asked for.

string camera_name         # unique
string camera_model_name   # such as BVS002C
string port                # network port, or USB port
string con_address         # IP address of a camera in a network
uint32 application_id      # which application to start with; 0 leaves it as it is
string interpret_as        # how to read results, such as Localizations or 50ByteStrings
string topic_status        # where to publish the status; empty for none
---
string error               # empty when it worked
""",
    "smartcam_msgs/srv/EnablePublishing": """\
# Publishes the results of a camera on a topic.

string camera_name         # as given at setup
string topic_for_outputs   # where to publish; empty ends it
float64 min_delay          # least time between two results in seconds
uint32 queue_size          # most results that wait; 0 is as usual
---
string error               # empty when it worked
""",
    "smartcam_msgs/srv/SmartcameraStop": """\
# Ends publishing and closes the camera.

string camera_name         # as given at setup
---
string error               # empty when it worked
""",
    "smartcam_msgs/srv/ChangeApplication": """\
# Switches to another application on the camera.

string camera_name         # as given at setup
uint32 application_id      # which application
---
string error               # empty when it worked
""",
    "smartcam_msgs/srv/Trigger50ByteString": """\
# Triggers, and reads the result as texts of up to 50 bytes.

string camera_name         # as given at setup
uint32 application_id      # which application, switched back afterwards; 0 is the active one
float64 timeout            # longest wait in seconds; 0 is as usual
---
string error               # empty when it worked
string[] strings
""",
    "smartcam_msgs/srv/TriggerResults": """\
# Triggers, and returns what comes, however it is read.

uint32 application_id       # which application, switched back afterwards; 0 is the active one
uint8[] input               # input data for this inspection; none is sent where it is empty
bool refuse_when_busy       # fail at once where the camera takes no trigger
uint32 results_per_trigger  # how many results the application sends; 0 is one
string interpret_as         # how to read them; empty is as usual
float64 timeout             # longest wait in seconds; 0 is as usual
---
string error                # empty when it worked
Result[] results
""",
    "smartcam_msgs/srv/TriggerLocalization": """\
# Triggers, and reads the result as localizations.

string camera_name         # as given at setup
uint32 application_id      # which application, switched back afterwards; 0 is the active one
float64 timeout            # longest wait in seconds; 0 is as usual
---
string error               # empty when it worked
Localization[] localizations
""",
    "smartcam_msgs/srv/StartCalibration": """\
# Begins a calibration. PerformCurrentAndGetNextStep tells the first step then.

string topic_image1                # topic with pictures of the camera; empty for none
string topic_image2                # the same, or SMARTCAMERA for this camera itself
float64 checkerboard_squaresize_m  # side of a square of the checkerboard; 0 is not known
string tf_frame_robot_tcp          # frame of the tool's tip in TF; empty: its pose is typed
string tf_frame_robot_base         # frame that poses are taken in; empty: the root above the tip
string fixed_camera                # True, False (it is on the flange), or empty to be asked
---
string error                       # empty when it worked
""",
    "smartcam_msgs/srv/PerformCurrentAndGetNextStep": """\
# Answers the step that was told last, and tells the next one. The first call answers nothing.

bool repeat_last_step   # go back to the step before
bool abort              # end without a calibration
float64[] value_inputs  # an answer for each of descriptions_for_needed_values
string[] text_inputs    # an answer for each of descriptions_for_needed_strings
string[] option_inputs  # an answer for each of descriptions_for_needed_options
---
string error            # why the step comes again; empty when it worked
string header_text
string description_text
string button_text      # empty at the end
string[] descriptions_for_needed_values
float64[] default_needed_values
string[] descriptions_for_needed_strings
string[] default_needed_strings
string[] descriptions_for_needed_options
string[] default_needed_options  # DEFAULT OPTION1 OPTION2 ...
""",
    "smartcam_msgs/srv/ExportCalibration": """\
# Copies a calibration into the folder exports of the calibrations.

string calibration_name  # as given in the calibration
string target_path       # name of the file, such as table.json or table.yaml
---
string error             # empty when it worked
""",
    "smartcam_msgs/srv/LoadCalibration": """\
# Loads a calibration, which TransformPixelPose uses from then on.

string calibration_name_or_path  # its name, or exports/NAME.json for an exported one
---
string error                     # empty when it worked
""",
    "smartcam_msgs/srv/TransformPixelPose": """\
# Returns the pose of the robot for what a camera sees, by the loaded calibration.

std_msgs/Header header     # when and in which frame it was seen; zeros are not said
float64 x                  # to the right, in the unit of the calibration
float64 y                  # upwards
float64 theta              # counter-clockwise in radians
string tf_frame_reference  # frame that the pose is wanted in; empty for the calibration's
---
string error               # empty when it worked
geometry_msgs/PoseStamped pose
""",
}
"""Texts of the files by name of the type."""
