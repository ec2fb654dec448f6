"""coloc view RUN|DIR."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coloc_graph.viewer import Viewer


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser(
        "view",
        help="see a result, or a run that is solved for it, in the browser",
        description="See a result, or a run that is solved for it, in the browser: robots, graph, covariances, and "
        "what is behind each edge. Ctrl-C ends it.",
    )
    command.add_argument("path", metavar="RUN|DIR", help="a run (.mcap), or a result of `coloc solve`")
    command.add_argument("--run", dest="run_path", metavar="RUN", help="the run of a result, if it is no longer there")
    command.add_argument("--compare", metavar="DIR2", help="another result of the same run, beside the first")
    command.add_argument("--host", default="127.0.0.1", help="address to listen at (127.0.0.1: this machine alone)")
    command.add_argument("--port", type=int, default=8080)
    command.add_argument("--no-browser", action="store_true", help="do not open a browser")
    command.add_argument("--dark", action="store_true", help="dark colours")
    command.add_argument(
        "--export", metavar="HTML", help="write what is shown to one page that needs no server, and end"
    )
    command.add_argument("--png", metavar="PNG", help="write a picture of it, and end; needs Chromium")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Make the scene, show it."""
    from pathlib import Path

    from coloc_graph.cli.printing import progress, warn
    from coloc_graph.errors import InputError
    from coloc_graph.run import open_run
    from coloc_graph.viewer import Viewer, is_run, scene_of_result, scene_of_run, with_other
    from coloc_graph.viewer.app import left_out
    from coloc_graph.viewer.browser import require_browser, write_png
    from coloc_graph.viewer.server import is_loopback, require_free

    writes = bool(args.export or args.png)
    port = 0 if writes else args.port
    require_free(args.host, port)  # before the work, not after it
    for out in (args.export, args.png):
        if out and not Path(out).absolute().parent.is_dir():
            raise InputError(f"{out} cannot be written, since there is no such folder; make it, or give another place")
    if args.png:
        require_browser()
    if is_run(args.path):
        with progress("stances measured") as report:
            scene = scene_of_run(open_run(args.path), report)
    else:
        scene = scene_of_result(args.path, args.run_path)
    if args.compare:
        scene = with_other(scene, args.compare)
    warn(left_out(scene))
    if not is_loopback(args.host) and not writes:
        warn([f"whoever reaches {args.host} can see and steer this viewer: it has no password"])
    with Viewer(scene, host="127.0.0.1" if writes else args.host, port=port, dark=args.dark) as viewer:
        if args.export:
            viewer.export(args.export)
            print(args.export)
        if args.png:
            write_png(viewer, args.png)
            print(args.png)
        if writes:
            return 0
        show(viewer, browser=not args.no_browser)
    return 0


def show(viewer: "Viewer", *, browser: bool) -> None:
    """Say where a viewer is, open it on a terminal, and wait for Ctrl-C, which ends it."""
    from contextlib import suppress

    with suppress(KeyboardInterrupt):
        announce(viewer, browser=browser)
        viewer.wait_closed()


def announce(viewer: "Viewer", *, browser: bool) -> None:
    """Say where a viewer is, and open it on a terminal."""
    import sys
    import webbrowser

    # stderr, since stdout is for results
    print(f"the viewer is at {viewer.url} (Ctrl-C ends it)", file=sys.stderr, flush=True)
    if browser and sys.stdout.isatty():
        webbrowser.open(viewer.url)
