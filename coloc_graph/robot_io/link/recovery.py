"""Recovery of a robot's missing messages: they are requested until they have come or are lost; `Recovery`."""

import threading

from coloc_graph.machine import machine
from coloc_graph.robot_io.link.robot_inbox import RobotInbox
from coloc_graph.robot_io.link.session import KEPT_KINDS, Session, Take

RECOVERY_PERIOD = 0.2  # s between two requests for missing messages
NEWEST_PERIOD = 1.0  # s without a message of a kind after which the newest one is requested
RECOVERY_TIMEOUT = 5.0  # s that a request may take


class Recovery:
    """Thread that requests the missing messages of one robot.

    Parameters
    ----------
    robot
        Name of the robot.
    inbox
        The robot's messages and their gaps.
    lock
        Guards the inbox.
    session
        The coordinator's session.
    receivers
        By kind of message: takes in a message that was requested.
    """

    def __init__(
        self,
        robot: str,
        inbox: RobotInbox,
        lock: threading.RLock,
        session: Session,
        receivers: dict[type, Take],
    ) -> None:
        self._robot, self._inbox, self._lock, self._session, self._receivers = robot, inbox, lock, session, receivers
        self._ended = machine.new_event()
        self._thread = machine.new_thread(target=self._run, name=f"recovery of {robot}")
        self._thread.start()

    def end(self, timeout: float) -> None:
        """End the thread; wait for it for `timeout` [s] at most."""
        self._ended.set()
        self._thread.join(timeout)

    def request(self, kind: type, which: str) -> bool:
        """Have the robot send some of its kept messages again.

        Parameters
        ----------
        kind
            Kind of message.
        which
            Selector of zenoh's cache: "_sn=FIRST..LAST", or "_max=1" for the newest.

        Returns
        -------
        bool
            True if the robot answered. No message at all is an answer only if its newest message comes on request:
            a robot that cannot be reached sends none either.
        """
        name = next(name for name, one in KEPT_KINDS.items() if one is kind)
        count = self._session.kept(f"coloc/{self._robot}/{name}", which, RECOVERY_TIMEOUT, self._receivers[kind])
        if count is None:
            return False
        return count > 0 or (which != "_max=1" and self.request(kind, "_max=1"))

    def _run(self) -> None:
        inbox = self._inbox
        while not self._ended.wait(0.0 if self._recover() else RECOVERY_PERIOD):
            # where the last message of a kind was lost no later one tells of the gap: the newest is requested
            for kind in KEPT_KINDS.values():
                quiet = machine.monotonic() - inbox.last_taken.get(kind, 0.0) > NEWEST_PERIOD
                if quiet and inbox.present and inbox.session == inbox.in_charge is not None:
                    self.request(kind, "_max=1")
                    inbox.last_taken[kind] = machine.monotonic()

    def _recover(self) -> bool:
        """Request each gap once; return True if a gap has become smaller, and something is still missing."""
        with self._lock:
            session, gaps = self._inbox.session, self._inbox.missing()
        more = False
        for kind, first, last in gaps:
            if session is None or not self._inbox.present:
                break
            answered = self.request(kind, f"_sn={first}..{last}")
            with self._lock:
                if answered and self._inbox.present:
                    self._inbox.answered(session, kind, first, last)
                left = [one for of, one, _ in self._inbox.missing() if of is kind]
                more |= bool(left) and left[0] != first
        return more
