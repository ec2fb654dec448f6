"""Says in words which Python and system this needs; pip, left alone, says that no GTSAM can be found."""

import sys

from setuptools import setup

if not (3, 11) <= tuple(sys.version_info[:2]) < (3, 15):
    sys.exit(
        "coloc-graph needs CPython 3.11 to 3.14, for which GTSAM 4.3 has wheels, and this is "
        f"{sys.version_info[0]}.{sys.version_info[1]}: make a virtual environment with one of these"
    )
if sys.platform == "win32":
    sys.exit("coloc-graph needs Linux or macOS: GTSAM 4.3 has no wheels for Windows; WSL will do")

setup()
