"""Emulated Creates in a process of their own, as a real robot is: a driver that does not run delays no wheel."""

import contextlib
import itertools
import os
import sys
from multiprocessing import get_context

from coloc_graph.robot_io.create.emulator import CreateEmulator

REALTIME_PRIORITY = 60  # of SCHED_FIFO, where the user may have it: above the driver's watchdog


class EmulatorProcess:
    """The process, a context manager; `robot` makes an emulated robot in it."""

    def __init__(self):
        context = get_context("spawn")
        self._pipe, far = context.Pipe()
        self._process = context.Process(target=_serve, args=(far,), daemon=True)
        self._process.start()
        far.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._pipe.close()
        self._process.join(10.0)

    @contextlib.contextmanager
    def robot(self, *arguments, **options):
        """A `CreateEmulator` whose attributes are read and written, and whose methods are called, from here."""
        number = self.ask("make", arguments, options)
        try:
            yield Robot(self, number)
        finally:
            self.ask("call", number, "close", (), {})

    def ask(self, *question):
        """The answer; what the emulator raises is raised here."""
        self._pipe.send(question)
        answer, error = self._pipe.recv()
        if error is not None:
            raise error
        return answer


class Robot:
    """The near end of an emulated robot."""

    def __init__(self, process, number):
        self.__dict__.update(_process=process, _number=number)

    def __getattr__(self, name):
        if callable(getattr(CreateEmulator, name, None)):
            return lambda *given, **options: self._process.ask("call", self._number, name, given, options)
        return self._process.ask("get", self._number, name)

    def __setattr__(self, name, value):
        self._process.ask("set", self._number, name, value)


def _serve(pipe):
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REALTIME_PRIORITY))
    sys.setswitchinterval(1e-4)
    robots, numbers = {}, itertools.count()
    while True:
        try:
            kind, *question = pipe.recv()
        except EOFError:
            return
        answer = error = None
        try:
            if kind == "make":
                robots[answer := next(numbers)] = CreateEmulator(*question[0], **question[1])
            elif kind == "call":
                number, name, given, options = question
                answer = getattr(robots[number], name)(*given, **options)
            elif kind == "get":
                answer = getattr(robots[question[0]], question[1])
            else:
                setattr(robots[question[0]], *question[1:])
        except Exception as raised:
            error = raised
        pipe.send((answer, error))
