"""URLs, transports and passwords in clients' requests."""

from __future__ import annotations

import base64

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError
from tests.frames.inside import (
    MAX_WRONG_PASSWORDS,
    Authentication,
    PasswordCheck,
    RequestedTransport,
    RtspError,
    RtspRequest,
    RtspTarget,
    requested_transport,
    target_of,
)
from tests.frames.rtsp.client import Reply, digest

URL = "rtsp://h:8554/left"
US = "192.0.2.7"


@pytest.mark.parametrize(
    ("url", "target"),
    [
        ("rtsp://h/left", RtspTarget("rtsp://h/left", "left", False)),
        ("rtsp://a:b@h:8554/left/?x=1", RtspTarget("rtsp://h:8554/left", "left", False)),
        ("rtsp://[::1]:8554/left/track1", RtspTarget("rtsp://[::1]:8554/left", "left", True)),
        ("rtsp://h/%6ceft/track2", RtspTarget("rtsp://h/left/track2", "left/track2", False)),
        ("rtsp://h", RtspTarget("rtsp://h/", "", False)),
        ("rtsp://h/track1", RtspTarget("rtsp://h/track1", "track1", False)),
    ],
)
def test_urls(url: str, target: RtspTarget) -> None:
    assert target_of(url) == target


@pytest.mark.parametrize(
    "url", ["*", "/left", "http://h/left", "rtsp:///left", "rtsp://h:x/a", "rtsp://[h/a"]
)
def test_text_that_is_no_url_is_refused(url: str) -> None:
    with pytest.raises(RtspError, match="URL") as caught:
        target_of(url)
    assert caught.value.status == 400


@pytest.mark.parametrize(
    ("transport", "requested"),
    [
        ("RTP/AVP;unicast;client_port=5000-5001", RequestedTransport(False, 5000, 5001)),
        ("RTP/AVP/UDP;unicast;client_port=5000;mode=play", RequestedTransport(False, 5000, 5001)),
        (f"RTP/AVP;unicast;destination={US};client_port=9-8", RequestedTransport(False, 9, 8)),
        ("rtp/avp/tcp;interleaved=2-3", RequestedTransport(True, 2, 3)),
        ("RTP/AVP/TCP;unicast", RequestedTransport(True, None, None)),
        (
            'RTP/SAVP;x, RTP/AVP;multicast,RTP/AVP/TCP;mode="PLAY"',
            RequestedTransport(True, None, None),
        ),
    ],
)
def test_transports(transport: str, requested: RequestedTransport) -> None:
    assert requested_transport(transport, US) == requested


@pytest.mark.parametrize(
    "transport",
    [
        "",
        "RTP/AVP",
        "RTP/AVP;multicast;client_port=5000-5001",
        "RTP/AVP;unicast;client_port=0-1",
        "RTP/AVP;unicast;client_port=65535",
        "RTP/AVP;unicast;client_port=5000-5000",
        "RTP/AVP;unicast;client_port=5000-5001-5002",
        "RTP/AVP;unicast;client_port=5000-5001;destination=192.0.2.8",
        "RTP/AVP;unicast;client_port=5000-5001;mode=record",
        "RTP/AVP/TCP;interleaved=255-256",
        "RTP/SAVP;unicast;client_port=5000-5001",
    ],
)
def test_other_transports_are_refused(transport: str) -> None:
    with pytest.raises(RtspError) as caught:
        requested_transport(transport, US)
    assert caught.value.status == 461


def challenged(gate: PasswordCheck) -> Reply:
    with pytest.raises(RtspError) as caught:
        gate.check(RtspRequest("DESCRIBE", URL, {}))
    assert caught.value.status == 401
    return Reply(401, {name.lower(): value for name, value in caught.value.headers[:1]}, b"")


def asked(authorization: str, method: str = "DESCRIBE", url: str = URL) -> RtspRequest:
    return RtspRequest(method, url, {"authorization": authorization})


def test_the_right_password_passes_as_often_as_wanted() -> None:
    gate = PasswordCheck(Authentication("me", "secret"))
    challenge = challenged(gate)
    for method in ("DESCRIBE", "SETUP", "PLAY") * 5:
        gate.check(asked(digest(challenge, method, URL, "me", "secret"), method))
    # live555 names the stream in its request for the track
    gate.check(asked(digest(challenge, "SETUP", URL, "me", "secret"), "SETUP", f"{URL}/track1"))
    gate.check(asked(digest(challenge, "PLAY", f"{URL}/", "me", "secret"), "PLAY", f"{URL}/"))


def test_another_password_user_method_url_nonce_or_realm_does_not() -> None:
    authentication = Authentication("me", "secret")
    gate, other = PasswordCheck(authentication), PasswordCheck(authentication)
    challenge = challenged(gate)
    right = digest(challenge, "DESCRIBE", URL, "me", "secret")
    for wrong in (
        asked(digest(challenge, "DESCRIBE", URL, "me", "Secret")),
        asked(digest(challenge, "DESCRIBE", URL, "you", "secret")),
        asked(right, "PLAY"),
        asked(right, url=URL + "2"),
        asked(digest(challenged(other), "DESCRIBE", URL, "me", "secret")),
        asked(right.replace('"smartcam"', '"other"')),
        asked(right + ", algorithm=SHA-256"),
        asked("Digest"),
    ):
        fresh = PasswordCheck(authentication)
        fresh._nonce = gate._nonce
        with pytest.raises(RtspError, match="wrong user or password"):
            fresh.check(wrong)
        fresh.check(asked(right))


def test_tries_are_counted() -> None:
    gate = PasswordCheck(Authentication("me", "secret"))
    ends = []
    for _ in range(MAX_WRONG_PASSWORDS):
        with pytest.raises(RtspError) as caught:
            gate.check(asked("Digest x=y"))
        ends.append(caught.value.fatal)
    assert ends == [False] * (MAX_WRONG_PASSWORDS - 1) + [True]


@given(st.text(st.characters(max_codepoint=255), max_size=60))
def test_no_text_is_an_authorization(text: str) -> None:
    gate = PasswordCheck(Authentication("me", "secret", allows_basic=True))
    for scheme in ("Digest ", "Basic ", ""):
        with pytest.raises(RtspError):
            gate.check(asked(scheme + text))


def test_basic_is_refused_unless_asked_for() -> None:
    request = asked("Basic " + base64.b64encode("me:gehe\u00edm".encode()).decode())
    PasswordCheck(Authentication("me", "gehe\u00edm", allows_basic=True)).check(request)
    for other in (
        Authentication("me", "gehe\u00edm"),
        Authentication("me", "x", allows_basic=True),
    ):
        with pytest.raises(RtspError, match="wrong user or password") as caught:
            PasswordCheck(other).check(request)
        schemes = [value.partition(" ")[0] for _, value in caught.value.headers]
        assert schemes == (["Digest", "Basic"] if other.allows_basic else ["Digest"])


@pytest.mark.parametrize(
    ("user", "password"), [("me", None), (None, "x"), ("", "x"), ("me", ""), ("a:b", "x")]
)
def test_user_and_password_go_together(user: str | None, password: str | None) -> None:
    with pytest.raises(ConfigurationError, match="user"):
        Authentication(user, password)
