"""The camera of a simulated robot: frames that a live world renders, over its Unix socket.

A client sends one line of JSON, {"robot": NAME}. The world answers with one line, {} or {"error": SENTENCE}, and then
sends frames: `HEADER` (stamp [ns, CLOCK_MONOTONIC, in the middle of the exposure], height, width), then height x width
grey bytes.
"""

import contextlib
import json
import socket
import struct

import numpy as np

from coloc_graph.errors import CameraError
from coloc_graph.robot_io.camera.source import WAIT, Clock, Frame, clock_ahead

#: Stamp [ns], height, width [px].
HEADER = struct.Struct("<qII")
MAX_PIXELS = 1 << 24  # px of an image
MAX_LINE = 4096  # bytes of the first line in either direction
ANSWER_TIMEOUT = 2.0  # s that the world may take to answer


class WorldCamera:
    """Robot's camera in the live world at a Unix socket. Raises `CameraError` if there is none."""

    def __init__(self, name: str, address: str, robot: str, clock: Clock) -> None:
        self._name, self._clock = name, clock
        self._buffer = bytearray()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.settimeout(ANSWER_TIMEOUT)
            self._socket.connect(address)
            self._socket.sendall(json.dumps({"robot": robot}).encode() + b"\n")
            while b"\n" not in self._buffer and len(self._buffer) < MAX_LINE:
                self._receive()
            line, _, rest = bytes(self._buffer).partition(b"\n")
            self._buffer = bytearray(rest)
            answer = json.loads(line)
            if answer != {}:
                raise CameraError(f"{name}: {answer['error']}")
        except (OSError, ValueError, TypeError, KeyError) as error:
            self.close()
            what = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise CameraError(f"{name} cannot be opened ({what}): is the simulated world running there?") from error
        except CameraError:
            self.close()
            raise
        self._socket.settimeout(WAIT)

    def grab(self) -> Frame | None:
        """Return the next frame, None if none comes for `WAIT`."""
        try:
            while len(self._buffer) < HEADER.size:
                self._receive()
            stamp, height, width = HEADER.unpack_from(self._buffer)
            if height * width > MAX_PIXELS:
                raise CameraError(f"{self._name} sent an image of {width} x {height} px: use a world of this version")
            while len(self._buffer) < HEADER.size + height * width:
                self._receive()
        except TimeoutError:
            return None
        except OSError as error:
            raise CameraError(f"{self._name} is lost ({error.strerror}): has the simulated world ended?") from error
        end = HEADER.size + height * width
        pixels = np.frombuffer(bytes(self._buffer[HEADER.size : end]), np.uint8).reshape(height, width)
        del self._buffer[:end]
        return Frame(stamp + clock_ahead(self._clock), pixels)

    def _receive(self) -> None:
        data = self._socket.recv(1 << 17)
        if not data:
            raise CameraError(f"{self._name} is lost: the simulated world closed the connection; open it again")
        self._buffer += data

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(OSError):
            self._socket.close()
