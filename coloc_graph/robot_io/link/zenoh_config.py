"""Configuration of zenoh: peers without scouting, TLS with certificates, access rules; `config_of`."""

import ipaddress
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from coloc_graph.errors import InputError

log = logging.getLogger(__name__)

COORDINATOR = "coordinator"  # the coordinator's name in keys and certificates
LEASE = 2000  # ms of silence after which a link is lost
REDIAL = 200  # ms until a lost link is dialled again for the first time
MAX_REDIAL = 1000  # ms, at most, between two attempts


@dataclass(frozen=True)
class Tls:
    """PEM files of one end: the team's certificate authority, its own certificate and private key."""

    ca: Path
    certificate: Path
    key: Path


def tls_of(folder: str | Path, name: str) -> Tls:
    """Certificates of one end in a folder made by `coloc certificates`."""
    folder = Path(folder)
    return Tls(folder / "ca.pem", folder / f"{name}.pem", folder / f"{name}.key")


def config_of(
    *,
    listen: str | None = None,
    connect: str | None = None,
    tls: Tls | None = None,
    robots: Sequence[str] = (),
    exposed: bool = False,
) -> zenoh.Config:
    """Configuration of zenoh for one end of the link.

    Parameters
    ----------
    listen
        Address that the coordinator listens on.
    connect
        Address that a robot connects to.
    tls
        Certificates of this end.
    robots
        Names of the team's robots, for the coordinator's access rules.
    exposed
        Accept connections from other machines without certificates.

    Raises
    ------
    InputError
        If the address is not valid, or other machines could connect without certificates.
    """
    address = listen or connect
    if address is None:
        raise InputError("a link listens or connects: give an address")
    _require_address(address, tls)
    if COORDINATOR in robots:
        raise InputError(f"a robot cannot be called `{COORDINATOR}`: give it another name in the team's description")
    if listen is not None and tls is None and not _is_loopback(listen):
        if not exposed:
            raise InputError(
                f"{listen} can be reached from other machines, which could steer the robots: make certificates with "
                "`coloc certificates` and give them with --tls, or say --exposed on a network that you trust"
            )
        log.warning("anyone who reaches %s can see and steer the robots: it has no certificates", listen)
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "timestamping/enabled": True,
        "transport/link/tx/lease": LEASE,
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": REDIAL, "period_max_ms": MAX_REDIAL, "period_increase_factor": 1.5,
        },
    }  # fmt: skip
    if tls is not None:
        settings |= _tls_settings(tls) | {
            "access_control": _rules_of_coordinator(robots) if listen else _RULES_OF_ROBOT
        }
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise InputError(f"{address} is not a valid address of a link ({error}); give tcp/HOST:PORT") from error
    return config


def _tls_settings(tls: Tls) -> dict[str, Any]:
    for file in (tls.ca, tls.certificate, tls.key):
        if not file.is_file():
            raise InputError(f"{file} does not exist: make certificates with `coloc certificates`")
    settings: dict[str, Any] = {
        "transport/link/tls/root_ca_certificate": str(tls.ca),
        "transport/link/tls/enable_mtls": True,
        # an end is identified by its certificate's common name, in the rules below, not by its address
        "transport/link/tls/verify_name_on_connect": False,
        "transport/link/tls/close_link_on_expiration": True,
    }
    for end in ("listen", "connect"):
        settings[f"transport/link/tls/{end}_certificate"] = str(tls.certificate)
        settings[f"transport/link/tls/{end}_private_key"] = str(tls.key)
    return settings


def _keys(who: str) -> list[str]:
    """All keys below a name, with those of caches and heartbeats, which wildcards do not match."""
    return [f"coloc/{who}/**", f"coloc/{who}/**/@adv/**"]


def _rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    return {
        "id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(keys),
    }  # fmt: skip


#: Kinds of zenoh messages that publish, and that subscribe.
_TELLS = ("put", "delete", "declare_queryable", "reply", "liveliness_token")
_ASKS = ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber")


def _rules_of_coordinator(robots: Sequence[str]) -> dict[str, Any]:
    """Access rules: a robot, by its certificate's common name, publishes, answers and hears under its own keys."""
    rules: list[dict[str, Any]] = []
    policies = []
    asks = [*_ASKS[:1], *_ASKS[2:]]
    for robot in robots:
        told = [f"coloc/{robot}/{kind}" for kind in ("hold", "question", "refusal")]
        own = [
            _rule(f"{robot} tells of itself", "ingress", _TELLS, _keys(robot)),
            _rule(f"{robot} hears what is for it", "ingress", asks, told),
            _rule(f"{robot} looks for the coordinator", "ingress", asks, _keys(COORDINATOR)),
            _rule(f"the coordinator to {robot}", "egress", ("put", "query"), _keys(robot)),
        ]
        rules += own
        policies.append({"rules": [*(rule["id"] for rule in own), *_SAID_TO_ALL], "subjects": [robot]})
    rules += [
        _rule(_SAID_TO_ALL[0], "egress", _ASKS, _keys("*")),
        _rule(_SAID_TO_ALL[1], "egress", ("liveliness_token",), _keys(COORDINATOR)),
    ]
    subjects = [{"id": robot, "cert_common_names": [robot]} for robot in robots]
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }  # fmt: skip


_SAID_TO_ALL = ("the coordinator asks", "the coordinator is there")

#: A robot accepts messages from, and sends messages to, the coordinator's certificate only.
_RULES_OF_ROBOT = {
    "enabled": True,
    "default_permission": "deny",
    "rules": [_rule(f"the coordinator, {flow}", flow, (*_TELLS, *_ASKS), _keys("*")) for flow in ("ingress", "egress")],
    "subjects": [{"id": COORDINATOR, "cert_common_names": [COORDINATOR]}],
    "policies": [{"rules": [f"the coordinator, {flow}" for flow in ("ingress", "egress")], "subjects": [COORDINATOR]}],
}


def _require_address(address: str, tls: Tls | None) -> None:
    protocol, _, place = address.partition("/")
    host, _, port = place.rpartition(":")
    if protocol not in ("tcp", "tls") or not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(
            f"`{address}` is not a valid address of a link; give tcp/HOST:PORT, or tls/HOST:PORT with certificates"
        )
    if (protocol == "tls") != (tls is not None):
        raise InputError(f"{address} and certificates belong together: give tls/HOST:PORT with --tls, or neither")


def _is_loopback(address: str) -> bool:
    host = address.partition("/")[2].rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
