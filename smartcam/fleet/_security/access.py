"""The rights of each role, and the engine's rules for them.

A program's role is its certificate's common name. Only :data:`RIGHTS` are allowed, from which
``docs/access.md`` is generated.
"""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from smartcam.fleet._bus.keys import Keys
from smartcam.fleet._json.services import SERVICES
from smartcam.fleet._program.program_name import names_of
from smartcam.fleet._security.certificates import AGENT, OPERATOR, ROLES, ROUTER, VIEWER

if TYPE_CHECKING:
    from collections.abc import Iterator

Does = Literal["put", "subscribe", "query", "answer", "present", "watch"]
Flow = Literal["ingress", "egress"]

MESSAGES: dict[Does, tuple[tuple[str, Flow], ...]] = {
    "put": (("put", "ingress"), ("declare_subscriber", "egress")),
    "subscribe": (("declare_subscriber", "ingress"), ("put", "egress")),
    "query": (("query", "ingress"), ("reply", "egress"), ("declare_queryable", "egress")),
    "answer": (("declare_queryable", "ingress"), ("query", "egress"), ("reply", "ingress")),
    "present": (("liveliness_token", "ingress"),),
    "watch": (
        ("liveliness_query", "ingress"),
        ("declare_liveliness_subscriber", "ingress"),
        ("liveliness_token", "egress"),
    ),
}
"""Zenoh's messages for each kind of use, and their direction as seen from Zenoh."""


class Right(NamedTuple):
    """A right, and the roles that have it.

    Attributes:
        what: the right in words.
        does: kind of use that the right allows.
        keys: patterns of the keys that may be used.
        roles: roles that have the right.
    """

    what: str
    does: Does
    keys: tuple[str, ...]
    roles: tuple[str, ...]


_ANY = Keys("*")  # keys of any fleet, since an authority is for one plant
_LOOKING = tuple(name for name, service in SERVICES.items() if not service.command)
_LOOKS, _ACTS, _SHARES = (VIEWER, OPERATOR, AGENT), (OPERATOR,), (AGENT,)

RIGHTS: tuple[Right, ...] = (
    Right(
        "see which agents and cameras are present",
        "watch",
        (_ANY.agent("*"), _ANY.camera("*", "**")),
        _LOOKS,
    ),
    *(
        Right(
            "be present under a name of its role",
            "present",
            (_ANY.program(names_of(role)),),
            (role,),
        )
        for role in _LOOKS
    ),
    Right("get results and states", "subscribe", (_ANY.results("**"), _ANY.states("**")), _LOOKS),
    *(
        Right("send queries as its role", "put", (_ANY.ask(role, "*", "**"),), (role,))
        for role in _LOOKS
    ),
    Right("get answers and frames", "subscribe", (_ANY.reply("*"), _ANY.frames("*")), _LOOKS),
    Right("get results in bundles", "subscribe", (_ANY.bundle("*"),), _LOOKS),
    Right("request the state of all cameras", "query", (_ANY.summary("*"),), _LOOKS),
    Right("JSON: list the cameras", "query", (_ANY.listing("**"),), _LOOKS),
    Right("JSON: request the outlets' accounts", "query", (_ANY.outlets("*", "*"),), _LOOKS),
    Right(
        "JSON: get topics", "subscribe", (_ANY.topic("*", "**"), _ANY.thesis_topic("**")), _LOOKS
    ),
    Right(
        "JSON: services that change nothing",
        "query",
        tuple(_ANY.service("**", name) for name in _LOOKING),
        _LOOKS,
    ),
    Right("command", "put", (_ANY.command("*", "**"),), _ACTS),
    Right("JSON: all services", "query", (f"{_ANY.root}/service/**", _ANY.thesis("*")), _ACTS),
    Right("make an agent read its file again", "query", (_ANY.reload("*"),), _ACTS),
    Right("read its file again", "answer", (_ANY.reload("*"),), _SHARES),
    Right("share cameras", "present", (_ANY.agent("*"), _ANY.camera("*", "**")), _SHARES),
    Right("reserve its own name", "present", (_ANY.start("*", "*"),), _SHARES),
    Right("see which agent has its name", "watch", (_ANY.start("*", "*"),), _SHARES),
    Right("see which programs are present", "watch", (_ANY.program("*"),), _SHARES),
    Right("get calls", "subscribe", (_ANY.command("*", "**"), _ANY.ask("*", "*", "**")), _SHARES),
    Right("answer calls", "put", (_ANY.reply("*"), _ANY.frames("*")), _SHARES),
    Right("publish results and states", "put", (_ANY.results("**"), _ANY.states("**")), _SHARES),
    Right("publish results in bundles", "put", (_ANY.bundle("*"),), _SHARES),
    Right("report the state of all its cameras", "answer", (_ANY.summary("*"),), _SHARES),
    Right("JSON: report its outlets' accounts", "answer", (_ANY.outlets("*", "*"),), _SHARES),
    Right("JSON: publish topics", "put", (_ANY.topic("*", "**"), _ANY.thesis_topic("**")), _SHARES),
    Right(
        "JSON: list, serve",
        "answer",
        (_ANY.listing("**"), f"{_ANY.root}/service/**", _ANY.thesis("*")),
        _SHARES,
    ),
)
"""Rights of the roles, for every fleet of the bus."""


def ros_rights(domain: int) -> tuple[Right, ...]:
    """Return the rights of ROS 2 in a domain: everything, for roles that may command.

    Names do not show whether a node only reads: a viewer's node could call any service.
    """
    keys = (f"{domain}/**", f"{domain}/**/@adv/**", f"@ros2_lv/{domain}/**")
    return tuple(Right("ROS 2", does, keys, (OPERATOR, AGENT)) for does in MESSAGES)


_EVERYTHING = ("**", "**/@adv/**", "@ros2_lv/**")
_ALL = tuple(Right("pass on", does, _EVERYTHING, (ROUTER,)) for does in MESSAGES)


def access_control(domain: int | None = None) -> dict[str, Any]:
    """Return the rules in the form of the engine's ``access_control``.

    Args:
        domain: domain of ROS 2 on the same bus; None without ROS.
    """
    rights = RIGHTS + _ALL + (() if domain is None else ros_rights(domain))
    keys: dict[tuple[str, str, Flow], dict[str, None]] = collections.defaultdict(dict)
    for right in rights:
        for role, message, flow in _each(right):
            keys[role, message, flow] |= dict.fromkeys(right.keys)
    rules = {
        (role, message, flow): {
            "id": f"{role} {message} {flow}",
            "messages": [message],
            "flows": [flow],
            "permission": "allow",
            "key_exprs": [*patterns],
        }
        for (role, message, flow), patterns in keys.items()
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*rules.values()],
        "subjects": [{"id": role, "cert_common_names": [role]} for role in ROLES],
        "policies": [
            {
                "subjects": [role],
                "rules": [rule["id"] for (whose, *_), rule in rules.items() if whose == role],
            }
            for role in ROLES
        ],
    }


def _each(right: Right) -> Iterator[tuple[str, str, Flow]]:
    for role in right.roles:
        for message, flow in MESSAGES[right.does]:
            yield role, message, flow
