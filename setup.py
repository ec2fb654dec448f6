"""Version check in words, the compiled kernel, and the package page: README with links that lead to the repository.

pip, left alone, says that no GTSAM can be found. The address of the repository is that of whoever publishes: the
workflow gives it as PROJECT_URL. Without one, links to files of the repository are written as their text alone.
"""

import os
import re
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.sdist import sdist

PARTS = ("frontend", "backend", "robot_io")  # links at the root to folders of the package

if not (3, 11) <= tuple(sys.version_info[:2]) < (3, 15):
    sys.exit(
        "coloc-graph needs CPython 3.11 to 3.14, for which GTSAM 4.3 has wheels, and this is "
        f"{sys.version_info[0]}.{sys.version_info[1]}: make a virtual environment with one of these"
    )
if sys.platform == "win32":
    sys.exit("coloc-graph needs Linux or macOS: GTSAM 4.3 has no wheels for Windows; WSL will do")


def package_page(readme: str, url: str) -> str:
    """README whose relative links and pictures are absolute, or plain text where there is no address."""

    def absolute(match: "re.Match[str]") -> str:
        mark, text, target = match.groups()
        if "://" in target or target.startswith("#"):
            return match.group(0)
        if not url:
            return "" if mark else text
        return f"{mark}[{text}]({url}/{'raw' if mark else 'blob'}/main/{target})"

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", absolute, readme)


class SdistWithLinks(sdist):
    """Source distribution with the links at the root, which setuptools leaves out."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        """Add the links to the tree."""
        super().make_release_tree(base_dir, files)
        for name in PARTS:
            Path(base_dir, name).symlink_to(Path("coloc_graph", name), target_is_directory=True)


URL = os.environ.get("PROJECT_URL", "").rstrip("/")
LINKS = {
    "Source": URL,
    "Documentation": f"{URL}/tree/main/docs",
    "Changelog": f"{URL}/blob/main/CHANGELOG.md",
    "Issues": f"{URL}/issues",
}

# C with the limited API, rather than numba or Cython: docs/detection.md. Without a compiler, or with COLOC_PURE=1, the
# package is pure Python that computes the same, more slowly.
KERNEL = Extension(
    "coloc_graph.frontend._kernel",
    [f"kernel/{name}.c" for name in ("components", "filters", "module", "spots")],
    depends=["kernel/kernel.h"],
    extra_compile_args=["-O3", "-std=c11", "-g0"],
    py_limited_api=True,
    optional=True,
)
PURE = bool(os.environ.get("COLOC_PURE"))

setup(
    ext_modules=[] if PURE else [KERNEL],
    options={} if PURE else {"bdist_wheel": {"py_limited_api": "cp311"}},
    cmdclass={"sdist": SdistWithLinks},
    long_description=package_page((Path(__file__).parent / "README.md").read_text(encoding="utf-8"), URL),
    long_description_content_type="text/markdown",
    project_urls=LINKS if URL else {},
)
