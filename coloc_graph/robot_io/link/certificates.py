"""Certificates for a team's link: an authority, and certificates of the coordinator and each robot.

With an authority of your own, have it sign certificates whose common names are the robots' names.
"""

import datetime
import os
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from coloc_graph.errors import InputError
from coloc_graph.robot_io.link.zenoh_config import COORDINATOR

VALID_DAYS = 365  # days for which certificates are valid


def make_certificates(
    folder: str | Path, robots: Sequence[str], days: int = VALID_DAYS, *, force: bool = False
) -> tuple[Path, ...]:
    """Write the authority's ca.pem and ca.key, and NAME.pem and NAME.key of the coordinator and each robot.

    Keys are readable by their owner only.

    Parameters
    ----------
    folder
        Folder to write into.
    robots
        Names of the robots.
    days
        Validity [days].
    force
        Replace existing files.

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    InputError
        If a file exists and `force` is not given, or a robot's name is reserved.
    """
    if taken := {"ca", COORDINATOR} & set(robots):
        raise InputError(f"a robot cannot be called `{min(taken)}`: give it another name in the team's description")
    if not 1 <= days <= 20 * 365:
        raise InputError(f"certificates are valid for 1 to {20 * 365} days, not for {days}: give another --days")
    folder = Path(folder)
    names = (COORDINATOR, *robots)
    paths = tuple(folder / f"{name}.{kind}" for name in ("ca", *names) for kind in ("pem", "key"))
    if not force and (there := [path for path in paths if path.exists()]):
        raise InputError(f"{there[0]} exists; replace it and all others with --force, or give another folder")
    folder.mkdir(parents=True, exist_ok=True)
    for path in paths:
        path.unlink(missing_ok=True)
    begin = datetime.datetime.now(datetime.UTC) - datetime.timedelta(hours=1)  # for clocks that are slightly behind
    end = begin + datetime.timedelta(days=days)
    ca_key = ec.generate_private_key(ec.SECP256R1())
    authority = _named("coloc-graph authority of a team")
    ca = _begun(authority, authority, ca_key, ca_key, begin, end)
    ca = ca.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    _write_pair(folder / "ca", ca_key, ca.add_extension(_usage(signs_certificates=True), critical=True), ca_key)
    for name in names:
        key = ec.generate_private_key(ec.SECP256R1())
        one = _begun(_named(name), authority, key, ca_key, begin, end)
        one = one.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        one = one.add_extension(_usage(signs_certificates=False), critical=True)
        both_ends = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        one = one.add_extension(x509.ExtendedKeyUsage(both_ends), critical=False)
        one = one.add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        _write_pair(folder / name, key, one, ca_key)
    return paths


def _named(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _begun(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    ca_key: ec.EllipticCurvePrivateKey,
    begin: datetime.datetime,
    end: datetime.datetime,
) -> x509.CertificateBuilder:
    """Start a certificate with what all have in common."""
    return (
        x509.CertificateBuilder(issuer, subject, key.public_key(), x509.random_serial_number(), begin, end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key()), critical=False)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _write_pair(
    path: Path, key: ec.EllipticCurvePrivateKey, one: x509.CertificateBuilder, ca_key: ec.EllipticCurvePrivateKey
) -> None:
    pem = serialization.Encoding.PEM
    plain = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    _write_new(path.with_name(f"{path.name}.key"), plain, 0o600)
    _write_new(path.with_name(f"{path.name}.pem"), one.sign(ca_key, hashes.SHA256()).public_bytes(pem), 0o644)


def _write_new(path: Path, data: bytes, mode: int) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:  # never readable by others
        file.write(data)
