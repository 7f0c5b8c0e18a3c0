"""Unusual cameras give all their pictures; test_bad_servers has faulty ones."""

from __future__ import annotations

import asyncio
import base64
import fractions
import itertools
import random
import re
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam import frames
from smartcam._extras import load
from smartcam.exceptions import FrameSourceError
from smartcam.frames._inside import read_stamp
from tests.frames.pictures import HEIGHT, WIDTH, stamped
from tests.frames.rtsp_client.camera import (
    COUNT,
    GOODBYE,
    GOP,
    SDP,
    Camera,
    Request,
    Session,
    camera_on,
    digest,
    h265_packets,
    h265_pictures,
    jpeg_packets,
    numbered,
    pictures,
    sender_report,
    sprop,
    units,
    with_ssrc,
    without_sets,
)

if TYPE_CHECKING:
    from smartcam.frames import Frame

pytestmark = [pytest.mark.real_time, pytest.mark.usefixtures("no_leaks")]

LIMIT = 30.0
"""Seconds after which a test fails."""

WHO = "me:s3cret@"


@pytest.fixture(scope="module")
def encoded() -> list[bytes]:
    return asyncio.run(pictures())


@pytest.fixture
def camera(encoded: list[bytes]) -> Camera:
    return Camera(encoded)


async def read(camera: Camera, count: int = 12, user: str = "", how: str = "") -> list[Frame]:
    """Check that frames are drawn ones, and return them."""
    got: list[Frame] = []
    async with asyncio.timeout(LIMIT), camera_on(camera) as where:
        url = f"rtsp://{user}{where}#timeout=3{how}"
        async with frames.open(url) as source, source.reader() as reader:
            async for frame in reader:
                got.append(frame)
                if len(got) == count:
                    break
    return got


def numbers(got: list[Frame]) -> list[int]:
    stamps = [read_stamp(frame.grey()) for frame in got]
    assert all(stamp is not None and stamp[1] == 1000 * stamp[0] for stamp in stamps)
    return [stamp[0] for stamp in stamps if stamp is not None]


def in_a_row(got: list[Frame]) -> bool:
    found = numbers(got)
    return all((after - before) % COUNT == 1 for before, after in itertools.pairwise(found))


# kinds of cameras


def sdp(old: str, new: str) -> dict[str, Any]:
    assert old in SDP
    return {"sdp": SDP.replace(old, new)}


FMTP = "a=fmtp:96 packetization-mode=1\r\n"

ODD: dict[str, dict[str, Any]] = {
    "nothing odd": {},
    "no fmtp": sdp(FMTP, ""),
    "lines end with LF alone": {"sdp": SDP.replace("\r\n", "\n")},
    "an absolute control": sdp("a=control:track1", "a=control:rtsp://10.1.2.3/cam/track1"),
    "no control at all": {"sdp": re.sub(r"a=control:.*\r\n", "", SDP)},
    "no Content-Base": {"base": False},
    "a query in the control": sdp("a=control:track1", "a=control:trackID=1?a=b&c=d"),
    "multicast told": sdp("c=IN IP4 0.0.0.0", "c=IN IP4 239.1.2.3/16"),
    "audio first": sdp(
        "m=video", "m=audio 0 RTP/AVP 8\r\na=rtpmap:8 PCMA/8000\r\na=control:track0\r\nm=video"
    ),
    "two videos, one unknown": sdp(
        "m=video", "m=video 0 RTP/AVP 97\r\na=rtpmap:97 VP9/90000\r\na=control:track0\r\nm=video"
    ),
    "small letters, blanks and tabs": sdp(
        "m=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000",
        " M=video  0  RTP/AVP  96 \r\n\ta=RTPMAP: 96\th264/90000 ",
    ),
    "lines of nothing": {"sdp": "\r\n" + SDP.replace("\r\n", "\r\n\r\n") + "\0\r\n=\r\nx"},
    "a port with a count": sdp("m=video 0", "m=video 49170/2"),
    "AVPF": sdp("RTP/AVP 96", "RTP/AVPF 96"),
    "the controls end with a slash": sdp("a=control:track1", "a=control:track1/"),
    "the source told is of another network": {"source": "10.9.8.7"},
    "the source told is none": {"source": "camera.local"},
    "two types in a line": sdp("RTP/AVP 96", "RTP/AVP 97 96"),
    "another channel than asked for": {"channel": 6},
    "a session without a timeout": {"session": "abc"},
    "a session with odd options": {"session": "abc; timeout=60;x=y"},
    "OPTIONS is unknown": {"answers": {"OPTIONS": "501 Not Implemented"}},
    "no answer to TEARDOWN": {"answers": {"TEARDOWN": None}},
    "answers without a number": {"headers": {"CSeq": ""}},
    "answers with always the same number": {"headers": {"CSeq": "1"}},
    "no reason": {
        "answers": {"OPTIONS": lambda one: f"RTSP/1.0 200\r\nCSeq: {one.cseq}\r\n\r\n".encode()}
    },
}


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("how", ["", "&transport=udp"], ids=["tcp", "udp"])
@pytest.mark.parametrize("name", ODD)
async def test_an_odd_camera_gives_all_its_pictures(camera: Camera, name: str, how: str) -> None:
    for key, value in ODD[name].items():
        setattr(camera, key, value)
    got = await read(camera, how=how)
    assert in_a_row(got)
    assert sum(frame.lost for frame in got) == 0
    assert "TEARDOWN" in camera.methods


async def test_camera_may_send_from_the_address_in_its_answer(
    camera: Camera,
) -> None:
    camera.sender = camera.source = "127.0.0.2"  # like a camera behind a recorder
    assert in_a_row(await read(camera, how="&transport=udp"))
    camera.source = ""
    with pytest.raises(FrameSourceError, match="expected a whole picture, got none"):
        await read(camera, how="&transport=udp")


@pytest.mark.parametrize("between", [" \r\n ", '"'])
async def test_parameters_may_be_in_several_lines(encoded: list[bytes], between: str) -> None:
    camera = Camera([without_sets(one) for one in encoded])
    sets = sprop(encoded[0])
    if between == '"':
        more = f'a=fmtp:96 sprop-parameter-sets="{sets}"\r\n'
    else:
        more = f"a=fmtp:96 profile-level-id=42c01f\r\na=fmtp:96 sprop-parameter-sets={sets};\r\n"
    camera.sdp = SDP.replace("a=control:track1", f"{more}a=control:track1")
    assert in_a_row(await read(camera))


async def test_parameters_may_be_in_the_description_alone(encoded: list[bytes]) -> None:
    camera = Camera([without_sets(one) for one in encoded])
    camera.sdp = SDP.replace(
        "packetization-mode=1", f"packetization-mode=1; sprop-parameter-sets={sprop(encoded[0])}"
    )
    assert in_a_row(await read(camera))


H265 = SDP.replace("H264", "H265").replace(FMTP, "")


@pytest.mark.parametrize("how", ["&transport=tcp", "&transport=udp"])
async def test_h265_is_read_whole(how: str) -> None:
    camera = Camera(h265_pictures(), H265, cut=h265_packets)
    got = await read(camera, 20, how=how)
    assert in_a_row(got)
    chance = random.Random(1)  # noqa: S311 - the same ones each time
    camera.change = lambda _, packets: [one for one in packets if chance.randrange(15)]
    numbers(await read(camera, 20, how=how))


async def test_h265_may_have_its_parameters_in_the_description_alone() -> None:
    frames_made = h265_pictures()
    sets = {one[0] >> 1: one for one in units(frames_made[0]) if one[0] >> 1 in (32, 33, 34)}
    names = dict(zip((32, 33, 34), ("sprop-vps", "sprop-sps", "sprop-pps"), strict=True))
    parameters = ";".join(
        f"{name}={base64.b64encode(sets[kind]).decode()}" for kind, name in names.items()
    )
    bare = [
        b"".join(b"\0\0\0\1" + one for one in units(data) if one[0] >> 1 < 32)
        for data in frames_made
    ]
    sdp = H265.replace("a=control:track1", f"a=fmtp:96 {parameters}\r\na=control:track1")
    assert in_a_row(await read(Camera(bare, sdp, cut=h265_packets)))


@pytest.mark.parametrize("how", ["&transport=tcp", "&transport=udp"])
async def test_jpegs_are_read_as_they_were_sent(how: str) -> None:
    made = [
        load("simplejpeg").encode_jpeg(
            np.repeat(stamped(number)[..., None], 3, axis=2), 95, "RGB", "420"
        )
        for number in range(COUNT)
    ]
    sdp = SDP.replace("AVP 96", "AVP 26").replace("a=rtpmap:96 H264/90000\r\n", "")
    camera = Camera(made, sdp.replace(FMTP, ""), cut=jpeg_packets)
    got = await read(camera, how=how)
    assert in_a_row(got)
    for frame in got:
        number = numbers([frame])[0]
        luma = load("simplejpeg").decode_jpeg(made[number], "GRAY")[..., 0]
        assert np.abs(frame.grey().astype(int) - luma).max() <= 1
    bytes_sent = await read(camera, 3, how=f"{how}&format=MJPEG")
    assert all(frame.format.name == "MJPEG" and in_a_row([frame]) for frame in bytes_sent)
    chance = random.Random(2)  # noqa: S311 - the same ones each time
    camera.change = lambda _, packets: [one for one in packets if chance.randrange(15)]
    lossy = await read(camera, 20, how=how)
    for before, after in itertools.pairwise(lossy):
        since = numbers([after])[0] - numbers([before])[0] - 1
        assert (since - after.lost) % COUNT == 0


@pytest.mark.parametrize("quality", [1, 30, 50, 75, 99])
async def test_jpegs_without_tables_have_those_of_their_quality(quality: int) -> None:
    made = load("simplejpeg").encode_jpeg(
        np.repeat(stamped(0)[..., None], 3, axis=2), quality, "RGB", "420"
    )

    def cut(data: bytes, sequence: int, stamp: int) -> list[bytes]:
        first, *rest = jpeg_packets(data, sequence, stamp)
        bare = [first[:20] + first[20 + 4 + 128 :], *rest]
        return [one[:17] + bytes((quality,)) + one[18:] for one in bare]

    sdp = SDP.replace("AVP 96", "AVP 26").replace("a=rtpmap:96 H264/90000\r\n", "")
    camera = Camera([made] * COUNT, sdp.replace(FMTP, ""), cut=cut)
    async with camera_on(camera) as where, frames.open(f"rtsp://{where}") as source:
        frame = await source.newest()
    luma = load("simplejpeg").decode_jpeg(made, "GRAY")[..., 0]
    assert np.abs(frame.grey().astype(int) - luma).max() <= 1


async def test_pictures_that_wait_for_others_come_in_their_order() -> None:
    codec = load("av").CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    codec.time_base = fractions.Fraction(1, 30)
    codec.options = {
        "crf": "15",
        "x264-params": "keyint=10:min-keyint=10:bframes=2:b-adapt=0:open-gop=0:repeat-headers=1",
    }
    coded = []
    for number in range(COUNT):
        picture = load("av").VideoFrame.from_ndarray(stamped(number), "gray")
        picture = picture.reformat(format="yuv420p")
        picture.pts = number
        coded += codec.encode(picture)
    coded += codec.encode(None)
    shown = [int(one.pts) for one in coded]
    assert shown != sorted(shown)
    place = iter(range(10**6))

    def cut(data: bytes, sequence: int, stamp: int) -> list[bytes]:
        number = next(place)
        told = stamp + 3000 * (shown[number % COUNT] - number % COUNT) & 0xFFFFFFFF
        return numbered(data, sequence, told)

    def again(_: Request) -> str:
        nonlocal place
        place = iter(range(10**6))
        return ""

    camera = Camera([bytes(one) for one in coded], cut=cut, answers={"PLAY": again})
    got = await read(camera, 40)
    assert in_a_row(got[-20:])
    assert numbers(got[:2])[0] < COUNT


async def test_after_never_gives_a_picture_of_before(camera: Camera) -> None:
    sent: dict[int, float] = {}

    async def note(_: Session, number: int) -> bool:
        sent[number] = time.monotonic()
        return False

    camera.ends, camera.every = note, 0.5
    async with asyncio.timeout(LIMIT), camera_on(camera) as where:
        url = f"rtsp://{where}#timeout=3&delay=0.02"
        async with frames.open(url) as source, source.reader():
            await source.newest()
            sent.clear()
            for _ in range(4):
                moment = time.monotonic()
                frame = await source.after(moment)
                last = max(number for number in sent if number % COUNT == numbers([frame])[0])
                assert moment <= sent[last]
                assert last == max(sent), "a picture came with the next one"


async def test_other_places_for_a_track_and_for_play(camera: Camera) -> None:
    def refuse(request: Request) -> str:
        return "459 Aggregate Operation Not Allowed" if not request.url.endswith("track1") else ""

    camera.answers["PLAY"] = refuse
    assert in_a_row(await read(camera))


async def test_a_range_that_is_refused_is_left_out(camera: Camera) -> None:
    camera.answers["PLAY"] = lambda one: "457 Invalid Range" if "range" in one.headers else ""
    assert in_a_row(await read(camera))


async def test_by_udp_where_the_connection_is_refused(camera: Camera) -> None:
    def refuse(request: Request) -> str:
        return "461 Unsupported Transport" if "TCP" in request.headers["transport"] else ""

    camera.answers["SETUP"] = refuse
    assert in_a_row(await read(camera))


async def test_packets_before_the_answer_to_play(camera: Camera) -> None:
    async def early(session: Session) -> None:
        session.playing = asyncio.create_task(session.play())
        await asyncio.sleep(0.1)

    camera.before["PLAY"] = early
    camera.answers["PLAY"] = lambda one: f"RTSP/1.0 200 OK\r\nCSeq: {one.cseq}\r\n\r\n".encode()
    assert in_a_row(await read(camera))


async def test_bytes_between_the_packets_are_skipped(camera: Camera) -> None:
    async def stray(session: Session, number: int) -> bool:
        session.writer.write(b"\xde\xad$\xbe\xef" * (number % 4))
        return False

    camera.ends = stray
    assert in_a_row(await read(camera))


async def test_server_may_send_a_request(camera: Camera) -> None:
    async def ask(session: Session, number: int) -> bool:
        if number == 3:
            session.writer.write(b"OPTIONS * RTSP/1.0\r\nCSeq: 9\r\n\r\n")
        return False

    camera.ends = ask
    assert in_a_row(await read(camera))
    (answer,) = {(one.url, one.cseq) for one in camera.asked if one.method == "RTSP/1.0"}
    assert answer == ("200", "9")


async def test_packets_on_unknown_channels(camera: Camera) -> None:
    camera.answers["SETUP"] = lambda one: (
        f"RTSP/1.0 200 OK\r\nCSeq: {one.cseq}\r\nSession: 1\r\n"
        "Transport: RTP/AVP/TCP;unicast;interleaved=4-5\r\n\r\n"
    ).encode()
    assert in_a_row(await read(camera))


# passwords

CHALLENGES = {
    "basic": ['Basic realm="x"'],
    "digest": ['Digest realm="a \\"b\\"", nonce="1"'],
    "md5": ['Digest realm="x", nonce="1", algorithm=MD5, qop="auth,auth-int", opaque="o"'],
    "sha": ['Digest realm="x", nonce="1", algorithm=SHA-256, qop="auth"'],
    "both": [
        'Digest realm="x", nonce="1", algorithm=MD5',
        'Digest realm="x",nonce="1",algorithm=SHA-256,qop="auth"',
        'Basic realm="x"',
    ],
}


@pytest.mark.parametrize("kind", CHALLENGES)
async def test_password_is_sent_in_the_requested_way(camera: Camera, kind: str) -> None:
    def gate(request: Request) -> Any:
        given = request.headers.get("authorization", "")
        hashed = "sha256" if kind in ("sha", "both") else "md5"
        if kind == "basic":
            ok = given == "Basic bWU6czNjcmV0"
        else:
            ok = given.startswith("Digest") and digest(request, "me", "s3cret", hashed)
            ok |= kind == "digest" and given.startswith('Digest username="me", realm="a \\"b\\""')
        if ok:
            return ""
        shown = "".join(f"WWW-Authenticate: {one}\r\n" for one in CHALLENGES[kind])
        return f"RTSP/1.0 401 Unauthorized\r\nCSeq: {request.cseq}\r\n{shown}\r\n".encode()

    camera.answers = dict.fromkeys(("OPTIONS", "DESCRIBE", "SETUP", "PLAY", "TEARDOWN"), gate)
    assert in_a_row(await read(camera, user=WHO))


async def test_a_nonce_may_be_new_for_each_request(camera: Camera) -> None:
    last = ""

    def gate(request: Request) -> Any:
        nonlocal last
        fresh = f'nonce="{last}"' in request.headers.get("authorization", "") and last
        last = f"n{len(camera.asked)}"
        if fresh:
            return ""
        challenge = f'Digest realm="x", nonce="{last}", stale=true'
        head = f"RTSP/1.0 401 No\r\nCSeq: {request.cseq}\r\nWWW-Authenticate: {challenge}\r\n\r\n"
        return head.encode()

    camera.answers = dict.fromkeys(("DESCRIBE", "SETUP", "PLAY"), gate)
    assert in_a_row(await read(camera, user=WHO))


async def test_redirect_to_another_host_gets_no_password(
    camera: Camera, encoded: list[bytes]
) -> None:
    other = Camera(encoded)
    async with asyncio.timeout(LIMIT), camera_on(other) as there, camera_on(camera) as where:
        to = there.replace("127.0.0.1", "localhost")
        camera.answers["DESCRIBE"] = f"302 Moved\r\nLocation: rtsp://{to}"
        with pytest.raises(FrameSourceError, match="a redirect on the same host and port"):
            await frames.open(f"rtsp://{WHO}{where}").__aenter__()
        assert not other.asked
        async with frames.open(f"rtsp://{WHO}{where}#elsewhere=yes") as source:
            assert numbers([await source.newest()])
        other.answers["DESCRIBE"] = '401 No\r\nWWW-Authenticate: Basic realm="x"'
        with pytest.raises(FrameSourceError, match="put USER:PASSWORD@"):
            await frames.open(f"rtsp://{WHO}{where}#elsewhere=yes").__aenter__()
        assert not any("authorization" in one.headers for one in other.asked)


# while it plays


async def test_session_is_kept_alive_by_another_method_after_a_refusal(camera: Camera) -> None:
    camera.session = "1;timeout=1"
    camera.answers["GET_PARAMETER"] = "405 Method Not Allowed"
    got = await read(camera, 150)
    assert in_a_row(got)
    asked = camera.methods[camera.methods.index("GET_PARAMETER") :]
    assert asked[:2] == ["GET_PARAMETER", "OPTIONS"]


async def test_keep_alive_request_may_have_no_answer(camera: Camera) -> None:
    camera.session = "1;timeout=1"
    camera.answers["GET_PARAMETER"] = None
    assert in_a_row(await read(camera, 200))
    assert camera.methods.count("GET_PARAMETER") >= 1


async def test_another_ssrc_goes_on_without_a_broken_picture(camera: Camera) -> None:
    camera.change = lambda number, packets: [
        with_ssrc(one, 7 if number < 100 else 8) for one in packets
    ]
    got = await read(camera, 130)
    numbers(got)


async def test_packets_twice_and_in_another_order_lose_nothing(camera: Camera) -> None:
    def mix(number: int, packets: list[bytes]) -> list[bytes]:
        return [packets[0], *packets[::-1]] if number % 3 else packets

    camera.change = mix
    for how in ("&transport=udp", "&transport=tcp"):
        got = await read(camera, 60, how=how)
        assert in_a_row(got)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("how", ["&transport=tcp", "&transport=udp"])
@pytest.mark.parametrize("every", [10, 17, 50, 100])
async def test_no_picture_is_broken_and_each_loss_is_counted(
    camera: Camera, how: str, every: int
) -> None:
    chance = random.Random(every)  # noqa: S311 - the same ones each time
    camera.change = lambda _, packets: [one for one in packets if chance.randrange(every)]
    got = await read(camera, 40, how=how)
    found = numbers(got)
    for before, after in itertools.pairwise(got):
        since = numbers([after])[0] - numbers([before])[0] - 1
        assert (since - after.lost) % COUNT == 0
    assert len(found) == 40


async def test_times_follow_the_camera_s_clock_after_its_first_report(camera: Camera) -> None:
    async def report(session: Session, number: int) -> bool:
        if number == 15:
            stamp = number * 3000 + (1 << 32) - 30_000 & 0xFFFFFFFF
            session.send(sender_report(1_000_000, stamp), 1)
        return False

    camera.ends, camera.every = report, 1 / 30
    got = await read(camera, 40)
    told = [frame for frame in got if frame.device_time is not None]
    assert len(told) > 10
    for before, after in itertools.pairwise(told):
        assert after.device_time - before.device_time == pytest.approx(1 / 30, abs=1e-6)  # type: ignore[operator]
    assert all(frame.captured <= frame.captured + frame.age for frame in got)
    assert abs(told[0].device_time - 1_000_000) < 2  # type: ignore[operator]


# streams that end


@pytest.mark.parametrize(
    ("way", "message"),
    [
        ("closes", "the server closed the connection"),
        ("says goodbye", "the server ended the stream .over."),
        ("tears down", r"the server ended the session \(TEARDOWN\)"),
        ("sends no more", "no packet came for 3 s|gave no frame"),
        ("forgets the session", "454 Session Not Found"),
    ],
)
async def test_ended_stream_reports_its_cause_and_the_next_reader_reconnects(
    camera: Camera, way: str, message: str
) -> None:
    async def end(session: Session, number: int) -> bool:
        if number != 20 or camera.connections != 2:
            return False
        if way == "closes":
            session.writer.close()
        elif way == "says goodbye":
            session.send(sender_report(1, 1) + GOODBYE, 1)
        elif way == "tears down":
            session.writer.write(b"TEARDOWN * RTSP/1.0\r\nCSeq: 1\r\n\r\n")
        elif way == "forgets the session":
            camera.answers["GET_PARAMETER"] = "454 Session Not Found"
            return False
        return True

    camera.ends = end
    camera.session = "1;timeout=1" if "forgets" in way else "1"
    async with (
        asyncio.timeout(LIMIT),
        camera_on(camera) as where,
        frames.open(f"rtsp://{where}#timeout=3") as source,
    ):
        with pytest.raises(FrameSourceError, match=message):
            async for _ in source:
                pass
        assert numbers([await source.newest()])
        assert camera.connections == 3


async def test_cancellation_anywhere_leaves_nothing_open(camera: Camera) -> None:
    async with camera_on(camera) as where:
        for steps in (0, 1, 3, 5, 8, 13, 21, 34, 55):
            source = frames.open(f"rtsp://{where}")
            task = asyncio.create_task(source.__aenter__())
            for _ in range(steps):
                await asyncio.sleep(0)
            task.cancel()
            await asyncio.wait([task])
            await source.close()


def test_the_pictures_have_key_frames(encoded: list[bytes]) -> None:
    keys = [number for number, one in enumerate(encoded) if frames_key(one)]
    assert keys == [*range(0, COUNT, GOP)]


def frames_key(data: bytes) -> bool:
    return b"\0\0\1\x65" in data
