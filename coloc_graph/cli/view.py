"""coloc view RUN|DIR|GRAPH.g2o."""

import argparse
from typing import TYPE_CHECKING

from coloc_graph.cli.place import add_force

if TYPE_CHECKING:
    from collections.abc import Callable
    from socket import socket

    from coloc_graph.viewer import Scene, Viewer


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "view",
        help="show a result, a run or a pose graph in the browser",
        description="Show a result in the browser: robots, graph, covariances, and the measurement behind each edge. A "
        "run or pose graph is solved first. Ctrl-C ends the viewer.",
    )
    command.add_argument("path", metavar="RUN|DIR|GRAPH", help="run (.mcap), result of `coloc solve`, or .g2o file")
    command.add_argument("--run", dest="run_path", metavar="RUN", help="the result's run, if it has moved")
    command.add_argument("--compare", metavar="DIR2", help="show another result of the same run beside the first")
    command.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1, this machine)")
    command.add_argument("--port", type=int, help="port to listen on (default: 8080, or the first free one after it)")
    command.add_argument("--no-browser", action="store_true", help="do not open a browser")
    command.add_argument("--dark", action="store_true", help="use dark colours")
    command.add_argument("--export", metavar="HTML", help="write a web page that needs no server, and end")
    command.add_argument("--png", metavar="PNG", help="write a picture with legend and scale, and end; needs Chromium")
    command.add_argument("--video", metavar="MP4", help="write a film of all stances, and end; needs Chromium")
    add_force(command)
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Make the scene and show or write it."""
    from pathlib import Path

    from coloc_graph.cli.printing import progress, warn
    from coloc_graph.errors import InputError
    from coloc_graph.run.atomic_file import require_writable
    from coloc_graph.viewer import Viewer
    from coloc_graph.viewer.access import is_loopback
    from coloc_graph.viewer.browser import require_browser, write_png
    from coloc_graph.viewer.notes import missing_parts
    from coloc_graph.viewer.video import SUFFIX, write_video

    writes = bool(args.export or args.png or args.video)
    for out in (args.export, args.png, args.video):
        if out:
            require_writable(out, force=args.force)
    if args.video and Path(args.video).suffix.lower() != SUFFIX:
        raise InputError(f"{args.video} is not the name of a film: give one that ends in {SUFFIX}")
    if args.png or args.video:
        require_browser()
    host, port = ("127.0.0.1", 0) if writes else (args.host, args.port)
    with take_port(port, host) as listener:  # before the work
        scene = _scene(args)
        warn(missing_parts(scene))
        if not is_loopback(host):
            warn([f"the viewer is open to anyone who knows its address and reaches {host}, without encryption"])
        with Viewer(scene, host=host, dark=args.dark, listener=listener) as viewer:
            if args.export:
                viewer.export(args.export)
                print(args.export)
            if args.png:
                write_png(viewer, args.png)
                print(args.png)
            if args.video:
                with progress("frames rendered") as report:
                    write_video(viewer, args.video, progress=report)
                print(args.video)
            if not writes:
                show(viewer, browser=not args.no_browser)
    return 0


def _scene(args: argparse.Namespace) -> "Scene":
    """Return the scene that the arguments describe."""
    from coloc_graph.cli.printing import progress
    from coloc_graph.errors import InputError
    from coloc_graph.run import open_run
    from coloc_graph.viewer import (
        is_pose_graph,
        is_run,
        scene_of_pose_graph,
        scene_of_result,
        scene_of_run,
        with_other,
    )

    if is_pose_graph(args.path):
        if args.compare or args.run_path:
            raise InputError(f"{args.path} is a pose graph: --compare and --run apply to results of runs only")
        return scene_of_pose_graph(args.path)
    if is_run(args.path):
        with progress("stances measured") as report:
            scene = scene_of_run(open_run(args.path), report)
    else:
        scene = scene_of_result(args.path, args.run_path)
    return with_other(scene, args.compare) if args.compare else scene


def take_port(port: int | None, host: str = "127.0.0.1", say: "Callable[[str], None] | None" = None) -> "socket":
    """Listen on the port that was asked for, or else on the default one or the first free one after it.

    Parameters
    ----------
    port
        Port that was asked for, None for the default one.
    host
        Address to listen on.
    say
        Called with a sentence that names the port if it is not the default one; without it, stderr is used.

    Raises
    ------
    InputError
        If the port that was asked for is taken, or cannot be listened on.
    """
    import sys

    from coloc_graph.viewer.server import DEFAULT_PORT, open_listener

    listener = open_listener(host, port)
    taken = listener.getsockname()[1]
    if port is None and taken != DEFAULT_PORT:
        sentence = f"port {DEFAULT_PORT} is taken: the viewer uses port {taken}"
        say(sentence) if say else print(sentence, file=sys.stderr, flush=True)
    return listener


def show(viewer: "Viewer", *, browser: bool) -> None:
    """Print a viewer's address, open it if stdout is a terminal, and wait for Ctrl-C."""
    from contextlib import suppress

    with suppress(KeyboardInterrupt):
        announce(viewer, browser=browser)
        viewer.wait_closed()


def announce(viewer: "Viewer", *, browser: bool) -> None:
    """Print a viewer's address, and open it if stdout is a terminal."""
    import sys
    import webbrowser

    # stderr, since stdout is for results
    print(f"the viewer is at {viewer.url} (Ctrl-C ends it)", file=sys.stderr, flush=True)
    if browser and sys.stdout.isatty():
        webbrowser.open(viewer.url)
