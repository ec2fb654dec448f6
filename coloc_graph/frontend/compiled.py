"""The compiled kernel of the front end (C, in kernel/), or None where it is not built: the same numbers, sooner."""

from contextlib import suppress
from importlib import import_module
from typing import Any

VERSION = 2  # of the kernel that this package calls; raised with each change of what it computes, here and in module.c

kernel: Any = None
with suppress(ImportError):  # there was no C compiler when the package was installed
    kernel = import_module("coloc_graph.frontend._kernel")
    if getattr(kernel, "VERSION", 0) != VERSION:
        kernel = None  # built from other sources: install the package again
