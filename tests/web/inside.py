"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.web import (
    _clouds,
    _connections,
    _emulator,
    _fleet,
    _fleet_view,
    _pictures,
    _routes,
    _serialize,
    _streams,
)
from smartcam.web._clouds import MAX_VIEWERS, PROTOCOL, SHOW_TIMEOUT, pack_cloud, thin_cloud
from smartcam.web._connections import (
    MAX_CONNECTIONS,
    MAX_HEAD_BYTES,
    SiteConnection,
    SiteConnections,
)
from smartcam.web._emulator import CALLS as EMULATOR_CALLS
from smartcam.web._emulator import MAX_PARTS as EMULATOR_MAX_PARTS
from smartcam.web._emulator import MAX_WAITING_CALLS
from smartcam.web._errors import RefusedError
from smartcam.web._fleet import CALLS, LINGER, MAX_CAMERAS
from smartcam.web._fleet import MAX_VIEWERS as FLEET_MAX_VIEWERS
from smartcam.web._fleet_rows import ERROR_MARK_SECONDS, MAX_KEPT_BYTES, MAX_QUEUE, line_of
from smartcam.web._fleet_socket import ALIVE_INTERVAL, MAX_ROWS
from smartcam.web._fleet_socket import PROTOCOL as FLEET_SOCKET_PROTOCOL
from smartcam.web._fleet_view import BAR_DURATION, PERIOD, SERIES_DURATION, SORTS, Filter
from smartcam.web._history import (
    BAR_SECONDS,
    MAX_BARS,
    MAX_FAILURES,
    MAX_PICTURES,
    SHIFT_SECONDS,
    SLOT_SECONDS,
    ShiftHistory,
)
from smartcam.web._live import CALLS as LIVE_CALLS
from smartcam.web._live import MAX_NEWS
from smartcam.web._live_view import (
    MAX_PARTS,
    MAX_RESULTS,
    MAX_SHOWN_RAW_BYTES,
    MAX_VALUE_CHARACTERS,
    ShownResult,
    value_fields,
)
from smartcam.web._pictures import MAX_VIEWERS as PICTURES_MAX_VIEWERS
from smartcam.web._pictures import PROTOCOL as PICTURES_PROTOCOL
from smartcam.web._pictures import JpegMaker
from smartcam.web._routes import MAX_BODY_BYTES, CallBody, _parse_json, _validate
from smartcam.web._serialize import MAX_HEX_BYTES, MAX_REPLY_BYTES, MAX_VALUES_BYTES
from smartcam.web._site import Site
from smartcam.web._streams import MAX_STREAMS, READER_TIMEOUT, StreamEvent, Streams
from smartcam.web._verdicts import outcome_of, verdicts
