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

#: A link that is silent for so long is lost [ms]; one that is lost is dialled again after [ms].
LEASE, REDIAL, REDIAL_AT_MOST = 2000, 200, 1000


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
    name: str | None = None,
    exposed: bool = False,
) -> zenoh.Config:
    """The configuration of the end that listens, with the team's `robots`, or of the one that connects, of `name`.

    Raises `InputError` for an address that is none, or that others reach without certificates, unless `exposed`.
    """
    address = listen or connect
    if address is None:
        raise InputError("a link listens or connects: give an address")
    _require_address(address, tls)
    if listen is not None and tls is None and not _is_loopback(listen):
        if not exposed:
            raise InputError(
                f"{listen} is reached by others, who could steer the robots: make certificates with `coloc "
                "certificates` and give them with --tls, or say --exposed on a network that you trust"
            )
        log.warning("whoever reaches %s can see and steer the robots: it has no certificates", listen)
    config = zenoh.Config()
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
        for file in (tls.ca, tls.certificate, tls.key):
            if not file.is_file():
                raise InputError(f"{file} is not there: make certificates with `coloc certificates`")
        settings["transport/link/tls/root_ca_certificate"] = str(tls.ca)
        for end in ("listen", "connect"):
            settings[f"transport/link/tls/{end}_certificate"] = str(tls.certificate)
            settings[f"transport/link/tls/{end}_private_key"] = str(tls.key)
        settings["transport/link/tls/enable_mtls"] = True
        settings["transport/link/tls/verify_name_on_connect"] = False
        if listen is not None:
            settings["access_control"] = _rules(robots)
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise InputError(f"{address} is no address of a link ({error}); give tcp/HOST:PORT") from error
    return config


def _rules(robots: Sequence[str]) -> dict[str, Any]:
    """A robot, by its certificate's common name, may publish and answer only as itself."""
    sends = ["put", "delete", "declare_queryable", "reply", "liveliness_token"]
    hears = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]
    rules = [
        {"id": f"{robot} sends", "permission": "allow", "flows": ["ingress"], "messages": sends,
         "key_exprs": [f"coloc/{robot}/**"]}
        for robot in robots
    ]  # fmt: skip
    rules += [
        {"id": "robots hear", "permission": "allow", "flows": ["ingress"],
         "messages": ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"],
         "key_exprs": ["coloc/coordinator/**"]},
        {"id": "the coordinator speaks", "permission": "allow", "flows": ["egress"], "messages": [*sends, *hears],
         "key_exprs": ["coloc/**"]},
    ]  # fmt: skip
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": robot, "cert_common_names": [robot]} for robot in robots],
        "policies": [
            {"rules": [f"{robot} sends", "robots hear", "the coordinator speaks"], "subjects": [robot]}
            for robot in robots
        ],
    }


def _require_address(address: str, tls: Tls | None) -> None:
    protocol, _, place = address.partition("/")
    if protocol not in ("tcp", "tls") or ":" not in place:
        raise InputError(f"`{address}` is no address of a link; give tcp/HOST:PORT, or tls/HOST:PORT with certificates")
    if (protocol == "tls") != (tls is not None):
        raise InputError(f"{address} and certificates belong together: give tls/HOST:PORT with --tls, or neither")


def _is_loopback(address: str) -> bool:
    host = address.partition("/")[2].rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
