"""A viser server on a port that is reserved from the start, which answers only requests with its token."""

import contextlib
import errno
import io
import logging
import socket
import threading
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection

from coloc_graph.errors import ColocError, InputError
from coloc_graph.viewer.access import Access, new_token
from coloc_graph.viewer.client_messages import is_permitted

DEFAULT_PORT = 8080
PORTS_TRIED = 20  # ports from the default one on, where none was asked for
MESSAGE_LIMIT = 1 << 16  # bytes of one message of a browser; the page's longest has 400
PROBE_TIMEOUT = 5.0  # s, for the answer to a request that must be refused
VISER_SERVER = "viser.infra._infra"  # module of the handler that viser serves

_starting = threading.Lock()
_log = logging.getLogger(__name__)


class PrivateServer(viser.ViserServer):
    """viser's server without its public share links, which any client could ask for.

    Attributes
    ----------
    token
        First part of the path of the viewer's address.
    """

    token = ""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: nothing is shared."""
        return None


def open_listener(host: str = "127.0.0.1", port: int | None = None) -> socket.socket:
    """Reserve a port while the scene is still being made.

    Parameters
    ----------
    host
        Address to listen on.
    port
        Port; 0 for any free one, None for `DEFAULT_PORT` or the first free one after it.

    Raises
    ------
    InputError
        The address is not one of this machine, or the port is taken.
    """
    if port is None:
        for tried in range(DEFAULT_PORT, DEFAULT_PORT + PORTS_TRIED):
            try:
                return _listen(host, tried)
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise _cannot_listen(host, tried, error) from error
        last = DEFAULT_PORT + PORTS_TRIED - 1
        raise InputError(f"ports {DEFAULT_PORT} to {last} of {host} are taken: give another with --port")
    if not 0 <= port <= 65535:
        raise InputError(f"there is no port {port}: give one from 0 to 65535")
    try:
        return _listen(host, port)
    except OSError as error:
        raise _cannot_listen(host, port, error) from error


def start_server(host: str, listener: socket.socket, label: str) -> PrivateServer:
    """Start viser on a listening socket, and verify that it refuses requests without the token.

    The server holds no data yet when this is verified.

    Raises
    ------
    ColocError
        Viser answers a request without the token.
    """
    port = listener.getsockname()[1]
    access = Access(host, new_token())
    gate = _Gate(listener, access)
    with _starting, contextlib.redirect_stdout(io.StringIO()), gate.installed():  # viser prints; stdout is for results
        server = PrivateServer(host=host, port=port, label=label, verbose=False)
    server.token, gate.gui = access.token, server.gui
    if not gate.is_served or not _refuses_strangers(listener):
        stop_server(server)
        listener.close()
        raise ColocError(f"viser {viser.__version__} would serve the viewer to anybody: install viser 1.1")
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server, without output."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def url_of(host: str, port: int, token: str) -> str:
    """Address at which a browser on this machine opens the viewer."""
    if host in ("0.0.0.0", "::"):
        host = "127.0.0.1" if host == "0.0.0.0" else "[::1]"
    elif ":" in host:
        host = f"[{host}]"
    return f"http://{host}:{port}/{token}"


def _listen(host: str, port: int) -> socket.socket:
    family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    return socket.create_server(address[:2], family=family, backlog=100)


def _cannot_listen(host: str, port: int, error: OSError) -> InputError:
    """Return the error for a failure to listen, with its remedy."""
    if isinstance(error, socket.gaierror):
        return InputError(f"{host} is not an address ({error.strerror}): give one of this machine with --host")
    if error.errno == errno.EADDRINUSE:
        return InputError(f"port {port} of {host} is taken, perhaps by another viewer: give another with --port")
    if error.errno == errno.EADDRNOTAVAIL:
        return InputError(f"{host} is not an address of this machine: give one that is with --host")
    return InputError(f"port {port} of {host} cannot be opened ({error.strerror}): give another with --port")


class _Gate:
    """Has viser serve a listening socket with access control, and drops messages that are not permitted.

    viser 1.1 calls `websockets.asyncio.server.serve` once, in its constructor, and gives no access to what it returns.
    """

    def __init__(self, listener: socket.socket, access: Access) -> None:
        self._listener, self._access = listener, access
        self.is_served = False
        self.gui: viser.GuiApi | None = None

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Replace `serve` while viser starts; servers of other libraries are started as they are."""
        library: Any = websockets.asyncio.server
        self._serve = library.serve
        library.serve = self._guarded
        try:
            yield
        finally:
            library.serve = self._serve

    def _guarded(self, handler: Any, host: Any = None, port: Any = None, **options: Any) -> Any:
        if getattr(handler, "__module__", "") != VISER_SERVER:
            return self._serve(handler, host, port, **options)
        self.is_served = True
        options |= {
            "process_request": self._access.guard(options["process_request"]),
            "create_connection": self._connection_type(),
            "max_size": MESSAGE_LIMIT,
            "logger": _silent_logger(),
        }
        return self._serve(handler, sock=self._listener, **options)

    def _connection_type(self) -> type[ServerConnection]:
        gate = self

        class FilteredConnection(ServerConnection):
            """A connection that receives permitted messages only."""

            async def recv(self, decode: bool | None = None) -> Any:
                """The next permitted message."""
                while not is_permitted(message := await super().recv(decode), gate.gui):
                    _log.debug("dropped a message of %d bytes that no honest browser sends", len(message))
                return message

        return FilteredConnection


def _silent_logger() -> logging.Logger:
    """A logger that writes nothing: a broken request would be a traceback in the user's terminal."""
    logger = logging.Logger("coloc_graph.viewer.connections", logging.CRITICAL + 1)
    logger.addHandler(logging.NullHandler())
    return logger


def _refuses_strangers(listener: socket.socket) -> bool:
    """Return whether the page and the websocket are refused to whoever lacks the token."""
    family, address = listener.family, listener.getsockname()
    if address[0] in ("0.0.0.0", "::"):
        address = ("127.0.0.1" if address[0] == "0.0.0.0" else "::1", *address[1:])
    upgrade = (
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: viser-v{viser.__version__}\r\n"
    )
    for more in ("", upgrade):
        try:
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.settimeout(PROBE_TIMEOUT)
                probe.connect(address)
                probe.sendall(f"GET / HTTP/1.1\r\nHost: localhost\r\n{more}\r\n".encode())
                status = probe.makefile("rb").readline().split()
        except OSError:
            return False
        if status[1:2] != [str(HTTPStatus.FORBIDDEN.value).encode()]:
            return False
    return True
