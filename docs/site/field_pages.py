"""Reference of team.toml and of the records of a run as Markdown, from the types."""

import dataclasses
import inspect
import re
from typing import Any

import msgspec
from numpydoc.docscrape import NumpyDocString

import coloc_graph.run.messages as messages
from coloc_graph.team import Team

DEFAULTS = {msgspec.NODEFAULT, dataclasses.MISSING}


def team_markdown() -> str:
    """Section for each table of team.toml, with its fields, defaults and meanings."""
    found: dict[type, str] = {}
    _collect(Team, "(top)", found)
    return "\n".join(_section(f"`{where}`" if where != "(top)" else "Top level", kind) for kind, where in found.items())


def records_markdown() -> str:
    """Section for each record of a run."""
    kinds = [
        kind
        for kind in vars(messages).values()
        if inspect.isclass(kind) and dataclasses.is_dataclass(kind) and kind.__module__ == messages.__name__
    ]
    return "\n".join(_section(kind.__name__, kind) for kind in kinds)


def _collect(kind: type, where: str, found: dict[type, str]) -> None:
    """Gather the structs of a team file, each with the name of the table in which it first stands."""
    if kind in found:
        return
    found[kind] = where
    for field in msgspec.structs.fields(kind):
        for inner, many in _structs(field.type):
            table = field.encode_name if where == "(top)" else f"{where.strip('[]')}.{field.encode_name}"
            _collect(inner, f"[[{table}]]" if many else f"[{table}]", found)


def _structs(annotation: Any, many: bool = False) -> list[tuple[type, bool]]:
    if inspect.isclass(annotation) and issubclass(annotation, msgspec.Struct):
        return [(annotation, many)]
    arguments = getattr(annotation, "__args__", ())
    inside = many or getattr(annotation, "__origin__", None) is tuple
    return [found for argument in arguments for found in _structs(argument, inside)]


def _section(title: str, kind: type) -> str:
    described = NumpyDocString(inspect.getdoc(kind) or "")
    meaning = {}
    for parameter in [*described["Parameters"], *described["Attributes"]]:
        for name in parameter.name.split(", "):
            meaning[name.strip("*")] = (parameter.type, " ".join(parameter.desc))
    lines = [f"## {title}", "", _text(" ".join(described["Summary"])), ""]
    lines += [_text(" ".join(described["Extended Summary"])), ""]
    lines += ["| field | type | default | |", "|---|---|---|---|"]
    for name, written, default in _fields(kind):
        stated, text = meaning.get(name, ("", ""))
        stated = stated or _written(kind.__annotations__.get(name, ""))
        lines.append(f"| `{written}` | {_text(stated)} | {default} | {_text(text)} |")
    return "\n".join([*lines, ""])


def _fields(kind: type) -> list[tuple[str, str, str]]:
    """Name, written name, and default of each field."""
    if issubclass(kind, msgspec.Struct):
        fields = msgspec.structs.fields(kind)
        return [(field.name, field.encode_name, _default(field.default, field.default_factory)) for field in fields]
    return [
        (field.name, field.name, _default(field.default, field.default_factory)) for field in dataclasses.fields(kind)
    ]


def _written(annotation: Any) -> str:
    return getattr(annotation, "__name__", None) or str(annotation)


def _default(value: Any, factory: Any) -> str:
    if value not in DEFAULTS:
        return "none" if value is None else f"`{value!r}`"
    if factory not in DEFAULTS:
        return f"`{factory()!r}`" if factory in (list, dict, tuple) else "its defaults"
    return "required"


def _text(text: str) -> str:
    """Escape what Markdown would take for a mark, outside of code."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([|*<>_\[\]])", r"\\\1", part) for part in parts)
