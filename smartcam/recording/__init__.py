"""Record what a camera says, play it back as an emulated camera, show it to Wireshark.

::

    with Recorder("run.mcap") as recorder:
        async with smartcam.connect(url, observers=[recorder]) as camera:
            ...
    async with replay(load_recording("run.mcap")) as emulator:
        emulator.url

The container is MCAP, which Foxglove and others open. It needs the extra ``record``.
"""

from smartcam.recording._bag_items import BagCounts
from smartcam.recording._bag_recorder import BagRecorder
from smartcam.recording._bag_recording import write_bag
from smartcam.recording._fleet_recorder import FleetRecorder
from smartcam.recording._fleet_replay import FleetReplay
from smartcam.recording._pcap import write_pcap
from smartcam.recording._reader import Recording, load_recording
from smartcam.recording._recorder import Recorder
from smartcam.recording._replay import ReplayedCamera, replay

__all__ = [
    "BagCounts",
    "BagRecorder",
    "FleetRecorder",
    "FleetReplay",
    "Recorder",
    "Recording",
    "ReplayedCamera",
    "load_recording",
    "replay",
    "write_bag",
    "write_pcap",
]
