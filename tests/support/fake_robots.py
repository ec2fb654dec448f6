"""Robots that answer as real ones do, with neither camera nor wheels, on real links in this process."""

import contextlib
import threading
import time
import uuid

from coloc_graph.robot_io.link.messages import Capture, Drive, EndCapture, Event, Status, Wheels
from coloc_graph.robot_io.link.robot_link import RobotLink


class FakeRobot:
    """One robot: it stands, says that it arrived wherever it is sent, and sees nothing; a context manager."""

    def __init__(self, name, address, *, session=None):
        self.session = session or uuid.uuid4().hex
        self.bodies = []
        self._capture, self._counts = None, {Wheels: 0, Event: 0}
        self._began, self._ended = time.monotonic_ns(), threading.Event()
        self.link = RobotLink(name, connect=address, handler=self._obey, session=self.session)
        self._thread = threading.Thread(target=self._report, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()
        self.link.close()

    def _number(self, kind):
        self._counts[kind] += 1
        return self._counts[kind] - 1

    def _obey(self, body):
        self.bodies.append(body)
        match body:
            case Capture():
                self._capture = body.capture
            case EndCapture():
                self._capture = None
                return "0"
            case Drive():
                number = self._number(Event)
                self.link.put(
                    Event(session=self.session, number=number, stamp=time.monotonic_ns(), kind="arrived",
                          text=str(body.number))
                )  # fmt: skip
        return ""

    def _report(self):
        while not self._ended.wait(0.1):
            now = time.monotonic_ns()
            self.link.put(
                Status(session=self.session, stamp=now, phase="idle", capture=self._capture, moving=False,
                       still_since=self._began, fault=None, camera_fault=None, hazards=[])
            )  # fmt: skip
            self.link.put(
                Wheels(session=self.session, number=self._number(Wheels), stamp=now, frame=self.session,
                       pose=(0.0, 0.0, 0.0), covariance=(1e-8, 0.0, 0.0, 1e-8, 0.0, 1e-8))
            )  # fmt: skip


@contextlib.contextmanager
def fake_team(names, address):
    """A fake robot for each name, by name."""
    with contextlib.ExitStack() as stack:
        yield {name: stack.enter_context(FakeRobot(name, address)) for name in names}
