"""MQTT over TLS, against Debian's mosquitto: trusted and untrusted brokers."""

from __future__ import annotations

from pathlib import Path

import pytest

from smartcam.outlets import Outlets
from tests.outlets.broker import broker, needs_mosquitto
from tests.outlets.outletkit import result, until

pytest.importorskip("aiomqtt")
pytest.importorskip("cryptography")
pytestmark = [pytest.mark.real_time, needs_mosquitto]


def section(port: int, scheme: str = "mqtts", **more: str) -> dict[str, dict[str, object]]:
    return {"mqtt": {"broker": f"{scheme}://127.0.0.1:{port}", "timeout": 10, **more}}


async def test_a_broker_whose_authority_is_known_gets_results(tmp_path: Path) -> None:
    from tests.outlets.authority import Authority

    lines = Authority(tmp_path, "plant").lines("127.0.0.1")
    async with (
        broker(tmp_path, lines) as there,
        Outlets(section(there.port, ca="plant.pem"), tmp_path) as outlets,
    ):
        outlets.offer_result(result(1))
        await until(lambda: outlets.states["mqtt"].counts.delivered == 1)


@pytest.mark.parametrize(
    ("host", "days", "ca", "told"),
    [
        ("127.0.0.1", 1.0, "other", "certificate verify failed"),
        ("127.0.0.1", 1.0, None, "certificate verify failed"),
        ("broker.example", 1.0, "plant", "mismatch"),
        ("127.0.0.1", -1.0, "plant", "certificate has expired"),
    ],
    ids=["wrong authority", "unknown authority", "wrong host", "expired"],
)
async def test_a_broker_that_is_not_trusted_gets_nothing(
    tmp_path: Path, host: str, days: float, ca: str | None, told: str
) -> None:
    from tests.outlets.authority import Authority

    Authority(tmp_path, "other")
    lines = Authority(tmp_path, "plant").lines(host, days=days)
    more = {} if ca is None else {"ca": f"{ca}.pem"}
    async with (
        broker(tmp_path, lines) as there,
        Outlets(section(there.port, **more), tmp_path) as outlets,
    ):
        outlets.offer_result(result(1))
        await until(lambda: told in outlets.states["mqtt"].trouble)
        account = outlets.states["mqtt"].counts
        assert (account.delivered, account.spooled) == (0, 1)


@pytest.mark.parametrize(("of_broker", "of_outlet"), [("tls", "mqtt"), ("plain", "mqtts")])
async def test_tls_at_one_side_only_is_trouble(
    tmp_path: Path, of_broker: str, of_outlet: str
) -> None:
    from tests.outlets.authority import Authority

    lines = Authority(tmp_path, "plant").lines("127.0.0.1")
    if of_broker == "plain":
        lines = "allow_anonymous true\n"
    async with broker(tmp_path, lines) as there:
        made = section(there.port, of_outlet, **({"ca": "plant.pem"} if of_outlet[4:] else {}))
        made["mqtt"]["timeout"] = 2
        async with Outlets(made, tmp_path) as outlets:
            outlets.offer_result(result(1))
            await until(lambda: bool(outlets.states["mqtt"].trouble))
            assert outlets.states["mqtt"].counts.spooled == 1


@pytest.mark.parametrize("text", [None, "no certificate\n"])
async def test_a_file_of_an_authority_that_is_none_is_told(
    tmp_path: Path, text: str | None
) -> None:
    if text is not None:
        (tmp_path / "ca.pem").write_text(text)
    async with Outlets(section(1, ca="ca.pem"), tmp_path) as outlets:
        await until(lambda: "ca.pem" in outlets.states["mqtt"].trouble)
