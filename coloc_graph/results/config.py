"""config.toml of a result: version, options and the team as stated, by which `solve` makes the same result again."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from coloc_graph._version import __version__
from coloc_graph.errors import InputError
from coloc_graph.frontend import FrontendOptions, TrackerOptions
from coloc_graph.input_file import convert, read_toml
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.team import Team, without_none

CONFIG = "config.toml"
_OF_A_RESULT = "solve the run again"
_OF_A_USER = "give config.toml of a result, or correct it"


@dataclass(frozen=True)
class Config:
    """Configuration of a result: version, options, and the team as stated."""

    version: str
    options: SolveOptions
    team: Team


def write_config(options: SolveOptions, team: Team, part: Path) -> None:
    """Write config.toml into `part` of a result."""
    config = {
        "version": __version__,
        "options": without_none(dataclasses.asdict(options)),
        "team": without_none(msgspec.to_builtins(team)),
    }
    (part / CONFIG).write_text(tomli_w.dumps(config), encoding="utf-8")


def read_config(path: str | Path) -> Config:
    """Return the configuration of a result; `InputError` where config.toml is missing or damaged."""
    file = Path(path) / CONFIG
    config = read_toml(file, _OF_A_RESULT)
    team = convert(file, config.get("team"), Team, _OF_A_RESULT)
    try:
        return Config(str(config["version"]), _options(dict(config["options"])), team)
    except (KeyError, TypeError, ValueError, AttributeError, InputError) as error:
        raise InputError(f"{file} is damaged ({error}); {_OF_A_RESULT}") from error


def read_options(file: str | Path) -> tuple[SolveOptions, Team | None, str]:
    """Read a config.toml to solve by.

    Parameters
    ----------
    file : str or Path
        config.toml of a result, or one like it: `[options]`, and `version` and `[team]` where they are stated.

    Returns
    -------
    (SolveOptions, Team or None, str)
        Options, the team that they were used with, and the version that wrote them.

    Raises
    ------
    InputError
        The file is missing, or states something that is no option.
    """
    file = Path(file)
    config = read_toml(file, _OF_A_USER)
    stated = config.get("options")
    if not isinstance(stated, dict):
        raise InputError(f"{file} has no table [options]; {_OF_A_USER}")
    if unknown := sorted(set(config) - {"version", "options", "team"}):
        raise InputError(f"{file}: `{unknown[0]}` is none of version, [options] and [team]; {_OF_A_USER}")
    try:
        options = _options(dict(stated))
    except (TypeError, ValueError, AttributeError, InputError) as error:
        raise InputError(f"{file}, [options]: {str(error).split('__init__() got an ')[-1]}; {_OF_A_USER}") from error
    team = convert(file, config["team"], Team, _OF_A_USER) if "team" in config else None
    return options, team, str(config.get("version", __version__))


def require_same_team(stated: Team, team: Team, file: str | Path, run: str | Path) -> None:
    """Raise `InputError` where a config.toml states another team than a run."""
    if stated == team:
        return
    had, has = msgspec.to_builtins(stated), msgspec.to_builtins(team)
    fields = ", ".join(sorted(key for key in had | has if had.get(key) != has.get(key)))
    raise InputError(
        f"{file} states another team than {run} (its {fields} differ), so that it cannot make the same result: remove "
        "[team] from it to use its options alone"
    )


def _options(stated: dict[str, Any]) -> SolveOptions:
    """Return the options of a table; unknown names and wrong types are errors."""
    frontend, others = None, dict(stated)
    if given := others.pop("frontend", None):
        frontend = FrontendOptions(**(given | {"tracker": TrackerOptions(**given.get("tracker", {}))}))
    SolveOptions(frontend=frontend, **others)
    return msgspec.convert(stated, SolveOptions)
