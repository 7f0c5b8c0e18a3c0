"""Sessions as rmw_zenoh opens them: peers that look for a router, with its advanced ends.

Their settings are those of ``DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5``, their ends those that
``rmw_publisher_data.cpp``, ``rmw_subscription_data.cpp``, ``rmw_service_data.cpp`` and
``rmw_client_data.cpp`` declare.
"""

from __future__ import annotations

import asyncio
import queue
from typing import Any

import pytest
import zenoh
import zenoh.ext

from smartcam.ros2 import Node
from smartcam.ros2._inside import LATCHED
from tests.processes import free_place
from tests.ros2.inside import Attachment, Entity
from tests.ros2.roskit import PATIENCE, STRING, TRIGGER, peer, soon, until

pytestmark = pytest.mark.real_time


def entity(node: Node, kind: Any, session: Any, name: str, type: Any, qos: Any) -> Entity:
    return Entity(kind, 7, str(session.zid()), 0, 1, "/", "talker", name, type.dds, type.hash, qos)


async def test_latched_topics_both_ways() -> None:
    place = free_place()
    async with Node("cam3", namespace="line1", listen=place, domain=7) as node:
        says = node.publisher("status", STRING, qos=LATCHED)
        says.publish(data="before")
        came: queue.Queue[Any] = queue.Queue()
        with peer(place) as session:
            subscriber = zenoh.ext.declare_advanced_subscriber(
                session,
                says.entity.key,
                lambda sample: came.put(sample),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
            for text in ("before", "after"):
                sample = await asyncio.to_thread(came.get, timeout=PATIENCE)
                assert says.type.decode(sample.payload.to_bytes()).data == text
                attachment = Attachment.decode(sample.attachment.to_bytes())
                assert attachment.gid == says.entity.gid
                if text == "before":
                    says.publish(data="after")
            del subscriber

            theirs = entity(node, "MP", session.info, "/theirs", says.type, LATCHED)
            publisher = zenoh.ext.declare_advanced_publisher(
                session,
                theirs.key,
                cache=zenoh.ext.CacheConfig(max_samples=1),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(
                    heartbeat=None, sporadic_heartbeat=0.5
                ),
                publisher_detection=True,
                congestion_control=zenoh.CongestionControl.DROP,
            )
            token = session.liveliness().declare_token(theirs.token)
            data = says.type.encode({"data": "theirs"})
            publisher.put(data, attachment=Attachment(1, 1, theirs.gid).encode())
            await until(lambda: "/theirs" in node.graph.topics())
            hears = node.subscribe("/theirs", STRING, qos=LATCHED)
            assert (await soon(anext(hears))).data == "theirs"
            token.undeclare()
            hears.close()
            await until(lambda: "/theirs" not in node.graph.topics())


async def test_a_node_is_the_router_that_peers_find_each_other_by() -> None:
    place = free_place()
    async with Node("cam3", listen=place, domain=7) as node:
        type = node.types.message(STRING)
        came: queue.Queue[Any] = queue.Queue()
        with peer(place) as one, peer(place) as other:
            key = f"7/chatter/{type.dds}/{type.hash}"
            one.declare_subscriber(key, lambda sample: came.put(sample.payload.to_bytes()))
            ours = node.subscribe("/chatter", STRING)
            said = type.encode({"data": "hello"})
            extra = Attachment(1, 1, bytes(16)).encode()
            async with asyncio.timeout(PATIENCE):
                while came.empty():
                    other.put(key, said, attachment=extra)
                    await asyncio.sleep(0.02)
            assert came.get() == said
            assert (await soon(anext(ours))).data == "hello"


async def test_services_both_ways() -> None:
    async def answer(_: Any) -> dict[str, Any]:
        return {"success": True, "message": "ours"}

    place = free_place()
    async with Node("cam3", listen=place, domain=7) as node:
        node.serve("~/trigger", TRIGGER, answer)
        type = node.types.service(TRIGGER)
        with peer(place) as session:
            theirs = entity(node, "SC", session.info, "/cam3/trigger", type, LATCHED)
            querier = session.declare_querier(
                theirs.key,
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=PATIENCE,
            )
            await until(lambda: querier.matching_status.matching)
            asked = Attachment(5, 1, theirs.gid)
            replies = querier.get(payload=type.request.encode({}), attachment=asked.encode())
            (reply,) = await asyncio.to_thread(list, replies)
            assert str(reply.ok.key_expr) == theirs.key
            assert type.response.decode(reply.ok.payload.to_bytes()).message == "ours"
            said = Attachment.decode(reply.ok.attachment.to_bytes())
            assert (said.number, said.gid) == (5, theirs.gid)
            assert said.time > 1_000_000_000_000_000_000

            def serve(query: Any) -> None:
                request = Attachment.decode(query.attachment.to_bytes())
                query.reply(
                    served.key,
                    type.response.encode({"success": True, "message": "theirs"}),
                    attachment=Attachment(request.number, 2, request.gid).encode(),
                )

            served = entity(node, "SS", session.info, "/theirs", type, LATCHED)
            queryable = session.declare_queryable(served.key, serve, complete=True)
            token = session.liveliness().declare_token(served.token)
            calls = node.client("/theirs", TRIGGER)
            assert (await soon(calls.call(timeout=PATIENCE))).message == "theirs"
            token.undeclare()
            queryable.undeclare()
