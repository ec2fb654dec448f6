"""-v and -q of all commands: the log of the work on stderr, or results and errors alone."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager

from coloc_graph.cli.printing import set_quiet


def add_verbosity(parser: argparse.ArgumentParser) -> None:
    """Add -v and -q to each command below a parser that does something."""
    below = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    for action in below:
        for command in action.choices.values():
            add_verbosity(command)
    if not below:
        how_much = parser.add_mutually_exclusive_group()
        how_much.add_argument("-v", "--verbose", action="store_true", help="log the work and causes of errors")
        how_much.add_argument("-q", "--quiet", action="store_true", help="print results and errors only")


@contextmanager
def verbosity(args: argparse.Namespace) -> Iterator[None]:
    """Print and log as -v and -q say while the block runs."""
    set_quiet(quiet=args.quiet)
    if not (args.verbose or args.quiet):
        yield
        return
    import logging

    if args.quiet:
        logging.disable(logging.INFO)
        try:
            yield
        finally:
            logging.disable(logging.NOTSET)
            set_quiet(quiet=False)
        return
    from coloc_graph.cli.nonblocking_log import NonBlockingHandler

    root, ours = logging.getLogger(), logging.getLogger("coloc_graph")
    handler, level = logging.StreamHandler(), ours.level
    handler.setFormatter(logging.Formatter("%(relativeCreated)6d ms %(name)s: %(message)s"))
    # programs that run until they are stopped log by themselves
    handler.addFilter(lambda _: not any(isinstance(one, NonBlockingHandler) for one in root.handlers))
    ours.addHandler(handler)
    ours.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        ours.removeHandler(handler)
        ours.setLevel(level)


def causes(error: BaseException) -> Iterator[str]:
    """Yield what an error was raised from, the nearest first."""
    cause = error.__cause__
    while cause is not None:
        yield f"caused by {type(cause).__name__}: {cause}"
        cause = cause.__cause__
