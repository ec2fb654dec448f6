"""A viser server that listens where it is told to, says so if it cannot, and is shared with nobody."""

import contextlib
import errno
import io
import ipaddress
import socket

import viser

from coloc_graph.errors import InputError


class PrivateServer(viser.ViserServer):
    """viser without its public share links, which any client could ask for."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: nothing is shared."""
        return None


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def require_free(host: str, port: int) -> None:
    """Raise `InputError` where a server cannot listen at an address: viser would take the next port, or hang."""
    if not 0 <= port <= 65535:
        raise InputError(f"there is no port {port}; give one from 0 to 65535")
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port that was just left is free
            probe.bind(address)
    except socket.gaierror as error:
        raise InputError(f"{host} is no address ({error.strerror}); give one of this machine with --host") from error
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            what = f"port {port} of {host} is taken, perhaps by another viewer; give another with --port"
        elif error.errno == errno.EADDRNOTAVAIL:
            what = f"{host} is not an address of this machine; give one that is with --host"
        else:
            what = f"port {port} of {host} cannot be opened ({error.strerror}); give another with --port"
        raise InputError(what) from error


def start_server(host: str, port: int, label: str) -> PrivateServer:
    """A running server; raises `InputError` where the address cannot be had."""
    require_free(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner, and stdout is for results
        server = PrivateServer(host=host, port=port, label=label, verbose=False)
    if port and server.get_port() != port:
        stop_server(server)
        raise InputError(f"port {port} of {host} is taken, perhaps by another viewer; give another with --port")
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop it, without a word."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def url_of(host: str, port: int) -> str:
    """Where a browser on this machine finds it."""
    if host in ("0.0.0.0", "::"):
        host = "127.0.0.1" if host == "0.0.0.0" else "[::1]"
    elif ":" in host:
        host = f"[{host}]"
    return f"http://{host}:{port}"
