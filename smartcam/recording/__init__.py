"""Record a camera's messages; replay them as an emulated camera, or convert them for Wireshark.

::

    with Recorder("run.mcap") as recorder:
        async with smartcam.connect(url, observers=[recorder]) as camera:
            ...
    async with replay(load_recording("run.mcap")) as emulator:
        emulator.url

The file format is MCAP, which Foxglove and other programs open. It needs the extra ``record``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.recording._bags.conversion import write_bag
    from smartcam.recording._bags.recorder import BagRecorder
    from smartcam.recording._folders.recorder import FleetRecorder
    from smartcam.recording._folders.replay import FleetReplay
    from smartcam.recording._pcap import write_pcap
    from smartcam.recording._pictures.folder import RotatingRecorder
    from smartcam.recording._reader import Recording, load_recording
    from smartcam.recording._recorder import Recorder
    from smartcam.recording._replays.replay import ReplayedCamera, replay

__all__ = [
    "BagRecorder",
    "FleetRecorder",
    "FleetReplay",
    "Recorder",
    "Recording",
    "ReplayedCamera",
    "RotatingRecorder",
    "load_recording",
    "replay",
    "write_bag",
    "write_pcap",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_bags.conversion": "write_bag",
            "_bags.recorder": "BagRecorder",
            "_folders.recorder": "FleetRecorder",
            "_folders.replay": "FleetReplay",
            "_pcap": "write_pcap",
            "_pictures.folder": "RotatingRecorder",
            "_reader": "Recording load_recording",
            "_recorder": "Recorder",
            "_replays.replay": "ReplayedCamera replay",
        },
    )
