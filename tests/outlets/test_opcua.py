"""Cameras as vision systems of OPC UA, for asyncua's client."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("asyncua")

from tests.outlets.opcuakit import cell, plc
from tests.outlets.outletkit import until

pytestmark = pytest.mark.real_time


async def test_a_job_gives_its_result_with_the_ids_that_the_client_gave(tmp_path: Path) -> None:
    async with cell(tmp_path) as there, plc(there.url) as client:
        await client.wait_for("Ready")
        heard = await client.hear(1024, 1018, 1013, 1023)
        job = await client.start_job("m-1", "p-1")
        await until(lambda: bool(heard.of(1024)))
        (told,) = heard.of(1024)
        assert told.JobId.Id == job
        assert told.MeasId.Id == "m-1"
        assert told.PartId.Id == "p-1"
        print(vars(told))
        await client.wait_for("Ready")
        await until(lambda: bool(heard.of(1023)))
        print([ (e.EventType.Identifier, e.Message.Text) for e in heard.events])
