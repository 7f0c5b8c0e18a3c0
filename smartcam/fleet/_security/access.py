"""Define the rights of each role, and convert them to rules for Zenoh.

A program's role is the common name in its certificate. Zenoh allows only the uses in
:data:`RIGHTS`, from which the table in ``docs/access.md`` is generated.
"""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from smartcam.fleet._bus.keys import Keys
from smartcam.fleet._json.services import SERVICES
from smartcam.fleet._program.program_name import names_pattern
from smartcam.fleet._security.certificates import AGENT, OPERATOR, ROLES, ROUTER, VIEWER

if TYPE_CHECKING:
    from collections.abc import Iterator

Use = Literal["put", "subscribe", "query", "answer", "announce", "watch"]
Flow = Literal["ingress", "egress"]

MESSAGES: dict[Use, tuple[tuple[str, Flow], ...]] = {
    "put": (("put", "ingress"), ("declare_subscriber", "egress")),
    "subscribe": (("declare_subscriber", "ingress"), ("put", "egress")),
    "query": (("query", "ingress"), ("reply", "egress"), ("declare_queryable", "egress")),
    "answer": (("declare_queryable", "ingress"), ("query", "egress"), ("reply", "ingress")),
    "announce": (("liveliness_token", "ingress"),),
    "watch": (
        ("liveliness_query", "ingress"),
        ("declare_liveliness_subscriber", "ingress"),
        ("liveliness_token", "egress"),
    ),
}
"""Zenoh's messages for each kind of use, and their direction; ``ingress``: from a program to
Zenoh."""


class Right(NamedTuple):
    """A right, and the roles that have it.

    Attributes:
        what: the right in words.
        use: kind of use that the right allows.
        keys: patterns of the keys that may be used.
        roles: roles that have the right.
    """

    what: str
    use: Use
    keys: tuple[str, ...]
    roles: tuple[str, ...]


_ANY = Keys("*")  # keys of any fleet: all fleets of a plant have one certificate authority
_READ_ONLY_SERVICES = tuple(name for name, service in SERVICES.items() if not service.is_command)
_ALL_PROGRAMS, _OPERATORS, _AGENTS = (VIEWER, OPERATOR, AGENT), (OPERATOR,), (AGENT,)

RIGHTS: tuple[Right, ...] = (
    Right(
        "see which agents and cameras are present",
        "watch",
        (_ANY.agent("*"), _ANY.camera("*", "**")),
        _ALL_PROGRAMS,
    ),
    *(
        Right(
            "announce itself under a name of its role",
            "announce",
            (_ANY.program(names_pattern(role)),),
            (role,),
        )
        for role in _ALL_PROGRAMS
    ),
    Right(
        "get results and states",
        "subscribe",
        (_ANY.results("**"), _ANY.states("**")),
        _ALL_PROGRAMS,
    ),
    *(
        Right("send questions as its role", "put", (_ANY.ask(role, "*", "**"),), (role,))
        for role in _ALL_PROGRAMS
    ),
    Right(
        "get replies and pictures", "subscribe", (_ANY.reply("*"), _ANY.frames("*")), _ALL_PROGRAMS
    ),
    Right("get results in bundles", "subscribe", (_ANY.bundle("*"),), _ALL_PROGRAMS),
    Right("request the state of all cameras", "query", (_ANY.summary("*"),), _ALL_PROGRAMS),
    Right("JSON: list the cameras", "query", (_ANY.listing("**"),), _ALL_PROGRAMS),
    Right("JSON: request the outlets' counts", "query", (_ANY.outlets("*", "*"),), _ALL_PROGRAMS),
    Right(
        "JSON: get topics",
        "subscribe",
        (_ANY.topic("*", "**"), _ANY.thesis_topic("**")),  # see docs/bus.md: the thesis
        _ALL_PROGRAMS,
    ),
    Right(
        "JSON: services that change nothing",
        "query",
        tuple(_ANY.service("**", name) for name in _READ_ONLY_SERVICES),
        _ALL_PROGRAMS,
    ),
    Right("command", "put", (_ANY.command("*", "**"),), _OPERATORS),
    Right("JSON: all services", "query", (f"{_ANY.root}/service/**", _ANY.thesis("*")), _OPERATORS),
    Right("make an agent read its file again", "query", (_ANY.reload("*"),), _OPERATORS),
    Right("read its file again", "answer", (_ANY.reload("*"),), _AGENTS),
    Right("share cameras", "announce", (_ANY.agent("*"), _ANY.camera("*", "**")), _AGENTS),
    Right("reserve its own name", "announce", (_ANY.start("*", "*"),), _AGENTS),
    Right("see which agents have its name", "watch", (_ANY.start("*", "*"),), _AGENTS),
    Right("see which programs are present", "watch", (_ANY.program("*"),), _AGENTS),
    Right(
        "get requests", "subscribe", (_ANY.command("*", "**"), _ANY.ask("*", "*", "**")), _AGENTS
    ),
    Right("reply, send pictures", "put", (_ANY.reply("*"), _ANY.frames("*")), _AGENTS),
    Right("publish results and states", "put", (_ANY.results("**"), _ANY.states("**")), _AGENTS),
    Right("publish results in bundles", "put", (_ANY.bundle("*"),), _AGENTS),
    Right("report the state of all its cameras", "answer", (_ANY.summary("*"),), _AGENTS),
    Right("JSON: report its outlets' counts", "answer", (_ANY.outlets("*", "*"),), _AGENTS),
    Right("JSON: publish topics", "put", (_ANY.topic("*", "**"), _ANY.thesis_topic("**")), _AGENTS),
    Right(
        "JSON: list cameras, answer services",
        "answer",
        (_ANY.listing("**"), f"{_ANY.root}/service/**", _ANY.thesis("*")),
        _AGENTS,
    ),
)
"""Rights of the roles, for every fleet of the bus."""


def ros_rights(domain: int) -> tuple[Right, ...]:
    """Return the rights of ROS 2 in a domain: everything, for roles that may command.

    Keys do not show whether a node only reads. So with these rights a node could call any service.
    """
    keys = (f"{domain}/**", f"{domain}/**/@adv/**", f"@ros2_lv/{domain}/**")
    return tuple(Right("ROS 2", use, keys, (OPERATOR, AGENT)) for use in MESSAGES)


_EVERYTHING = ("**", "**/@adv/**", "@ros2_lv/**")
_ROUTER_RIGHTS = tuple(Right("pass on", use, _EVERYTHING, (ROUTER,)) for use in MESSAGES)


def access_control(domain: int | None = None) -> dict[str, Any]:
    """Return the rules in the form of Zenoh's ``access_control``.

    Args:
        domain: domain of ROS 2 on the same bus; None without ROS.
    """
    rights = RIGHTS + _ROUTER_RIGHTS + (() if domain is None else ros_rights(domain))
    keys: dict[tuple[str, str, Flow], dict[str, None]] = collections.defaultdict(dict)
    for right in rights:
        for role, message, flow in _messages_of(right):
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
                "rules": [
                    rule["id"] for (rule_role, *_), rule in rules.items() if rule_role == role
                ],
            }
            for role in ROLES
        ],
    }


def _messages_of(right: Right) -> Iterator[tuple[str, str, Flow]]:
    for role in right.roles:
        for message, flow in MESSAGES[right.use]:
            yield role, message, flow
