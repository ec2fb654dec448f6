"""A network between two ends of a TCP link that can be cut and mended."""

import contextlib
import selectors
import socket
import threading


class Relay:
    """Passes on what comes at its own `port` to `to` on this machine, and back; a context manager.

    While it is `cut` it holds everything back, without a word to either end, as a radio that is out of range does;
    what it held goes on when it is mended. New connections while it is cut get no answer either.
    """

    def __init__(self, to):
        self.to = to
        self.held_back = False
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._pairs = {}
        self._ended = False
        self._thread = threading.Thread(target=self._pass_on, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._ended = True
        self._thread.join()
        for one in (self._listener, *self._pairs):
            one.close()

    def cut(self):
        self.held_back = True

    def mend(self):
        self.held_back = False

    def drop(self):
        """End all connections."""
        for one in list(self._pairs):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def _pass_on(self):
        with selectors.DefaultSelector() as ready:
            ready.register(self._listener, selectors.EVENT_READ)
            while not self._ended:
                if self.held_back:
                    threading.Event().wait(0.005)
                    continue
                for key, _ in ready.select(0.02):
                    if key.fileobj is self._listener:
                        self._connect(ready)
                    elif key.fileobj in self._pairs:
                        self._forward(ready, key.fileobj)

    def _connect(self, ready):
        near, _ = self._listener.accept()
        try:
            far = socket.create_connection(("127.0.0.1", self.to), 1.0)
        except OSError:
            near.close()
            return
        for one, other in ((near, far), (far, near)):
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._pairs[one] = other
            ready.register(one, selectors.EVENT_READ)

    def _forward(self, ready, one):
        try:
            data = one.recv(1 << 16)
            if data:
                self._pairs[one].sendall(data)
                return
        except OSError:
            pass
        for end in (one, self._pairs[one]):
            ready.unregister(end)
            del self._pairs[end]
            end.close()
