"""Private names of the room for its helpers of tests, or for several tests."""

from __future__ import annotations

from smartcam.recording import _recorder
from smartcam.recording._folder import FileName, RecordingFolder, files_of
from smartcam.recording._folders import files, pictures, writer
from smartcam.recording._folders.files import FolderFiles, Limits
from smartcam.recording._mcap import form, records
from smartcam.recording._mcap.form import (
    FORMAT,
    GAP,
    KINDS,
    MAX_VALUES,
    PICTURE_SCHEMAS,
    Item,
    RecordedPicture,
    load_compress,
    message_fields,
    message_of,
    nanoseconds,
)
from smartcam.recording._picture_matching import PictureMatcher
from smartcam.recording._pictures import messages
from smartcam.recording._pictures.messages import picture_message
from smartcam.recording._recorder import MAX_WAITING_BYTES
from smartcam.recording._replays import schedule
from smartcam.recording._replays.pictures import ReplayedPictures
from smartcam.recording._replays.schedule import (
    ApplicationRuns,
    Change,
    RecordedRun,
    ReplayPlan,
    plan_replay,
)
