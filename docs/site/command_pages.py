"""Reference of the command line as Markdown, from the parsers."""

import argparse
import re

from coloc_graph.cli import parser


def parsers() -> list[argparse.ArgumentParser]:
    """Parsers of all commands and subcommands that run, in the order of the help."""
    return [one for one in _below(parser()) if _subparsers(one) is None]


def commands_markdown() -> str:
    """Section for each command: its use, its description, and a table of each group of arguments."""
    return "\n".join(_section(one) for one in parsers())


def _below(top: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    commands = _subparsers(top)
    inner = [] if commands is None else list(dict.fromkeys(commands.choices.values()))
    return [top, *(found for one in inner for found in _below(one))]


def _subparsers(one: argparse.ArgumentParser) -> "argparse._SubParsersAction[argparse.ArgumentParser] | None":
    return next((action for action in one._actions if isinstance(action, argparse._SubParsersAction)), None)


def _section(one: argparse.ArgumentParser) -> str:
    usage = re.sub(r"^usage: ", "", one.format_usage().strip())
    lines = [f"## {one.prog}", "", _cell(one.description or ""), "", "```text", usage, "```", ""]
    for group in one._action_groups:
        actions = [action for action in group._group_actions if action.help is not argparse.SUPPRESS]
        actions = [action for action in actions if not isinstance(action, argparse._HelpAction)]
        if not actions:
            continue
        title = {"positional arguments": "Arguments", "options": "Options"}.get(group.title or "", group.title)
        lines += [f"**{title}**", "", *([_cell(group.description), ""] if group.description else [])]
        lines += ["| | |", "|---|---|"]
        lines += [f"| {_invocation(one, action)} | {_cell(_help(one, action))} |" for action in actions]
        lines.append("")
    return "\n".join(lines)


def _invocation(one: argparse.ArgumentParser, action: argparse.Action) -> str:
    return f"`` {one._get_formatter()._format_action_invocation(action)} ``"


def _help(one: argparse.ArgumentParser, action: argparse.Action) -> str:
    return one._get_formatter()._expand_help(action) if action.help else ""


def _cell(text: str) -> str:
    """Escape what Markdown would take for a mark, and set options and `code` as code."""
    parts = re.split(r"(`[^`]*`|(?<![\w-])--[a-z][\w-]*)", " ".join(text.split()))
    return "".join(_part(part) for part in parts)


def _part(text: str) -> str:
    if text.startswith("--") and len(text) > 2:
        return f"`{text}`"
    return text if text.startswith("`") else re.sub(r"([|*<>_\[\]])", r"\\\1", text)
