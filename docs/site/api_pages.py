"""Reference of the Python names, as Markdown around autodoc's directives."""

import inspect
import re
import sys
from importlib import import_module
from pathlib import Path

from public_names import home_of, homes

MAX_SHOWN = 200  # characters of a constant's value that are shown


def module_markdown(path: str) -> str:
    """Directives for the public names of a module that are described in its page."""
    module = import_module(path)
    blocks = [f".. automodule:: {path}\n   :no-members:"]
    for name in homes()[path]:
        value = getattr(module, name)
        if inspect.isclass(value):
            kind = "autoexception" if issubclass(value, BaseException) else "autoclass"
            ours = any(base.__module__.startswith("coloc_graph.") for base in value.__mro__[1:])
            bases = "\n   :show-inheritance:" if kind == "autoexception" else "\n   :inherited-members:" * ours
            blocks.append(f".. {kind}:: {path}.{name}\n   :members:{bases}")
        elif inspect.isfunction(value):
            blocks.append(f".. autofunction:: {path}.{name}")
        else:
            blocks.append(f".. autodata:: {path}.{name}\n   :no-value:")
    return "```{eval-rst}\n" + "\n\n".join(blocks) + "\n```\n"


def top_markdown() -> str:
    """Table of the names of `coloc_graph` itself, each with a link to its description."""
    top = import_module("coloc_graph")
    rows = []
    for name in sorted(top.__all__, key=str.lower):
        if name.startswith("_"):
            continue
        first = (inspect.getdoc(getattr(top, name)) or "").split("\n\n")[0]
        role = "func" if inspect.isfunction(getattr(top, name)) else "class"
        role = "exc" if name.endswith(("Error", "Warning")) else role
        target = f"{{py:{role}}}`{name} <{home_of(name)}.{name}>`"
        rows.append(f"| {target} | {markdown_of(' '.join(first.split()))} |")
    return "| | |\n|---|---|\n" + "\n".join(rows) + "\n"


def markdown_of(text: str) -> str:
    """Escape what Markdown would take for a mark, outside of code."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([|*<>_\[\]])", r"\\\1", part) for part in parts)


def describe_constant(name: str, value: object, lines: list[str]) -> None:
    """Replace the description of a constant's type, which autodoc takes, by its comment in the source and its value."""
    if lines and (type(value).__doc__ or "").strip().startswith(lines[0].strip()):
        word = name.rpartition(".")[2]
        files = (getattr(module, "__file__", None) for key, module in sorted(sys.modules.items()) if _ours(key))
        texts = (Path(file).read_text(encoding="utf-8") for file in files if file and file.endswith(".py"))
        found = (re.search(rf"^{word}\b[^\n]*?  # (.+)$", text, re.MULTILINE) for text in texts)
        comment = next((match[1] for match in found if match), "")
        shown = f"Value: ``{value!r}``" if len(repr(value)) < MAX_SHOWN else ""
        lines[:] = [part for text in (f"{comment}." if comment else "", shown) if text for part in (text, "")]


def _ours(module: str) -> bool:
    return module.split(".")[0] == "coloc_graph"


def restructured(lines: list[str]) -> None:
    """Make a docstring safe for reStructuredText in place: `code` stays code, single marks stay what they are."""
    for index, line in enumerate(lines):
        parts = re.split(r"(``[^`]*``|`[^`]*`)", line)
        made = [f"``{part.strip('`')}``" if part.startswith("`") else _escaped(part) for part in parts]
        lines[index] = re.sub(r"(?<=\w``)(?=\w)", r"\\ ", "".join(made))


def _escaped(text: str) -> str:
    text = re.sub(r"(?<![\w*])(\*+)(?=\w)(?!args\b|kwargs\b|options\b)", lambda mark: "\\*" * len(mark[1]), text)
    text = re.sub(r"(?<=\w)\*(?=\W|$)", r"\\*", text)
    text = text.replace("|", "\\|")
    return re.sub(r"(?<=\w)_(?=[^\w]|$)", r"\\_", text)
