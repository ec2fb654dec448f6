"""`python -m coloc_graph.cli` is `coloc`."""

import sys

from coloc_graph.cli import main

sys.exit(main())
