"""Check of GTSAM's version: other versions than the tested ones are refused."""

from importlib.metadata import PackageNotFoundError, version

from coloc_graph.errors import ColocError


def require_gtsam(installed: str | None = None) -> None:
    """Raise `ColocError` unless GTSAM 4.3 is installed: solvers and factors differ between versions."""
    if installed is None:
        try:
            installed = version("gtsam")
        except PackageNotFoundError:
            installed = "none"
    if installed.split(".")[:2] != ["4", "3"]:
        raise ColocError(
            f"coloc-graph needs GTSAM 4.3 and found {installed}; in a virtual environment with CPython 3.11 to 3.14 "
            "on Linux or macOS, run: pip install 'gtsam>=4.3,<4.4'"
        )
