"""How zenoh is set up: peers without scouting, one that listens, TLS with certificates and rules of who may what."""

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

#: The coordinator's name, as robots have theirs.
COORDINATOR = "coordinator"
#: A link that is silent for so long is lost [ms]; one that is lost is dialled again after [ms].
LEASE = 2000
REDIAL = 200
REDIAL_AT_MOST = 1000


@dataclass(frozen=True)
class Tls:
    """Files of one end: the team's certificate authority, its own certificate and private key (PEM)."""

    ca: Path
    certificate: Path
    key: Path


def tls_of(folder: str | Path, name: str) -> Tls:
    """The certificates of one end in a folder that `coloc certificates` made."""
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
    """The configuration of the end that listens, to the team's `robots`, or of a robot's, which connects.

    Raises `InputError` for an address that is none, or that others reach without certificates, unless `exposed`.
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
                f"{listen} is reached by others, who could steer the robots: make certificates with `coloc "
                "certificates` and give them with --tls, or say --exposed on a network that you trust"
            )
        log.warning("whoever reaches %s can see and steer the robots: it has no certificates", listen)
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
            "period_init_ms": REDIAL, "period_max_ms": REDIAL_AT_MOST, "period_increase_factor": 1.5,
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
            raise InputError(f"{address} is no address of a link ({error}); give tcp/HOST:PORT") from error
    return config


def _tls_settings(tls: Tls) -> dict[str, Any]:
    for file in (tls.ca, tls.certificate, tls.key):
        if not file.is_file():
            raise InputError(f"{file} is not there: make certificates with `coloc certificates`")
    settings: dict[str, Any] = {
        "transport/link/tls/root_ca_certificate": str(tls.ca),
        "transport/link/tls/enable_mtls": True,
        # who it is is told by the certificate's common name, in the rules below, not by an address
        "transport/link/tls/verify_name_on_connect": False,
        "transport/link/tls/close_link_on_expiration": True,
    }
    for end in ("listen", "connect"):
        settings[f"transport/link/tls/{end}_certificate"] = str(tls.certificate)
        settings[f"transport/link/tls/{end}_private_key"] = str(tls.key)
    return settings


def _keys(who: str) -> list[str]:
    """All keys below, with those of caches and heartbeats, which wildcards leave out."""
    return [f"coloc/{who}/**", f"coloc/{who}/**/@adv/**"]


def _rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    return {
        "id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(keys),
    }  # fmt: skip


#: What who has something to say sends, and what who wants to know sends.
_TELLS = ("put", "delete", "declare_queryable", "reply", "liveliness_token")
_ASKS = ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber")


def _rules_of_coordinator(robots: Sequence[str]) -> dict[str, Any]:
    """A robot, by its certificate's common name, may publish and answer only as itself, and hears what is for it."""
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

#: Only who has the coordinator's certificate is obeyed, and told anything.
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
        raise InputError(f"`{address}` is no address of a link; give tcp/HOST:PORT, or tls/HOST:PORT with certificates")
    if (protocol == "tls") != (tls is not None):
        raise InputError(f"{address} and certificates belong together: give tls/HOST:PORT with --tls, or neither")


def _is_loopback(address: str) -> bool:
    host = address.partition("/")[2].rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
