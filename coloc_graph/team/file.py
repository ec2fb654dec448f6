"""team.toml, read and written."""

from pathlib import Path
from typing import Any

import msgspec

from coloc_graph.errors import TeamError
from coloc_graph.team.team import Team


def read_team(path: str | Path) -> Team:
    """The team described by a TOML file; `TeamError` names the file and the path in it."""
    path = Path(path)
    try:
        return msgspec.toml.decode(path.read_bytes(), type=Team)
    except OSError as error:
        raise TeamError(f"{path}: cannot be read ({error.strerror}); give the path of a team.toml") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise TeamError(f"{path}: {error}; see docs/team.md for the fields") from error


def write_team(team: Team, path: str | Path) -> None:
    """Write a team as TOML; what `read_team` reads back equal."""
    import tomli_w

    Path(path).write_text(tomli_w.dumps(without_none(msgspec.to_builtins(team))), encoding="utf-8")


def without_none(value: Any) -> Any:
    """TOML has no null: a field that is None is left out, and reads back as its default."""
    if isinstance(value, dict):
        return {key: without_none(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list | tuple):
        return [without_none(inner) for inner in value]
    return value
