"""Access to the viewer's server: the token in the address, and the Host and Origin of every request.

Any page in the user's browser can send requests to 127.0.0.1, and a foreign name can be made to resolve to it (DNS
rebinding), so that listening on the loopback address alone protects nothing. The token is the first part of the path,
which viser's page keeps when it opens its websocket.
"""

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from http import HTTPStatus
from inspect import isawaitable

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

TOKEN_BYTES = 16  # random bytes in a token
# a Host header: a name, an IPv4 address or an IPv6 address in brackets, and a port
HOST_HEADER = re.compile(r"(?:\[(?P<ipv6>[0-9a-f:.]+)\]|(?P<name>[a-z0-9._-]+))(?::\d{1,5})?", re.ASCII)
REFUSED = "Open the viewer by the complete address that coloc printed; it holds a token.\n"
# headers of each page: its address, which holds the token, is neither passed on nor stored
PAGE_HEADERS = {
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}

Answer = Response | None
ProcessRequest = Callable[[ServerConnection, Request], Answer | Awaitable[Answer]]


def is_loopback(host: str) -> bool:
    """Return whether an address is reached from this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True)
class Access:
    """Requests that a server answers.

    Parameters
    ----------
    host
        Address that the server listens on.
    token
        First part of the path of every permitted request.
    """

    host: str
    token: str

    def refusal(self, request: Request) -> str | None:
        """Reason to refuse a request, None for a permitted one."""
        hosts = request.headers.get_all("Host")
        host = hosts[0].lower() if len(hosts) == 1 else ""
        if not self._is_own_name(host):
            return f"its Host is {', '.join(hosts) or 'missing'}"
        origins = request.headers.get_all("Origin")
        if any(origin.lower() not in (f"http://{host}", f"https://{host}") for origin in origins):
            return f"its Origin is {', '.join(origins)}"
        if not hmac.compare_digest(_split(request.path)[0].encode(), self.token.encode()):
            return "its address does not hold the token"
        return None

    def guard(self, serve_page: ProcessRequest) -> ProcessRequest:
        """Wrap a server's `process_request`: refused requests are answered by 403 and never reach it."""

        async def process_request(connection: ServerConnection, request: Request) -> Answer:
            if self.refusal(request) is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSED)
            answer = serve_page(connection, replace(request, path=_split(request.path)[1]))
            answer = await answer if isawaitable(answer) else answer
            if answer is not None:
                answer.headers.update(PAGE_HEADERS)
            return answer

        return process_request

    def _is_own_name(self, host: str) -> bool:
        """True if a Host header names this server in a way that no DNS server can forge."""
        match = HOST_HEADER.fullmatch(host)
        if match is None:
            return False
        name = match["ipv6"] or match["name"]
        if name == "localhost" or name == self.host.lower():
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return not is_loopback(self.host) and name == socket.gethostname().lower()
        return address.is_loopback or not is_loopback(self.host)


def new_token() -> str:
    """Random token, safe in a path."""
    return secrets.token_urlsafe(TOKEN_BYTES)


def _split(path: str) -> tuple[str, str]:
    """First part of a path, and the rest of it."""
    first, slash, rest = path.partition("?")[0].removeprefix("/").partition("/")
    return first, slash + rest or "/"
