"""Reading and writing of team.toml."""

from pathlib import Path
from typing import Any

import msgspec

from coloc_graph.errors import TeamError
from coloc_graph.input_file import MAX_DESCRIPTION_SIZE, convert, parse_toml, read_text
from coloc_graph.team.team import Team


def read_team(path: str | Path) -> Team:
    """Read a team from a TOML file.

    Raises
    ------
    TeamError
        The file cannot be read, or is not a team; the message names the file and the field.
    """
    path = Path(path)
    remedy = "give the path of a team.toml"
    return parse_team(path, read_text(path, remedy, limit=MAX_DESCRIPTION_SIZE, error=TeamError))


def parse_team(path: Path, text: str) -> Team:
    """Read a team from a TOML text of the file `path`; see `read_team`."""
    return team_of_fields(path, parse_toml(path, text, error=TeamError))


def team_of_fields(path: Path, fields: Any) -> Team:
    """Make a team of the fields of a TOML file at `path`.

    Raises
    ------
    TeamError
        A field is missing, unknown or wrong.
    """
    return convert(path, fields, Team, "see docs/team.md for the fields", error=TeamError)


def write_team(team: Team, path: str | Path) -> None:
    """Write a team as TOML, which `read_team` reads back equal."""
    import tomli_w

    Path(path).write_text(tomli_w.dumps(without_none(msgspec.to_builtins(team))), encoding="utf-8")


def without_none(value: Any) -> Any:
    """Drop fields that are None: TOML has no null, and a missing field reads back as its default."""
    if isinstance(value, dict):
        return {key: without_none(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list | tuple):
        return [without_none(inner) for inner in value]
    return value
