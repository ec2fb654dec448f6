"""Write a calibration into a team.toml and keep everything else in it, comments included."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from coloc_graph.errors import TeamError
from coloc_graph.input_file import MAX_DESCRIPTION_SIZE, read_text
from coloc_graph.run.atomic_file import write_atomically
from coloc_graph.team import Camera, Mount, Team, parse_team

#: Fields that a calibration replaces.
CAMERA_FIELDS = ("width", "height", "fx", "fy", "cx", "cy", "model", "distortion", "noise_px", "bias_px")
MOUNT_FIELDS = ("height", "tilt_deg", "roll_deg", "height_sigma", "tilt_sigma_deg", "roll_sigma_deg")


def write_camera(path: str | Path, robot: str, camera: Camera, out: str | Path | None = None) -> None:
    """Write a camera's `CAMERA_FIELDS` for a robot into the team at `path`, or into a copy at `out`."""
    _write(Path(path), robot, "camera", _values(camera, CAMERA_FIELDS), Path(out or path))


def write_mount(path: str | Path, robot: str, mount: Mount, out: str | Path | None = None) -> None:
    """Write a mount's `MOUNT_FIELDS` for a robot into the team at `path`, or into a copy at `out`."""
    _write(Path(path), robot, "mount", _values(mount, MOUNT_FIELDS), Path(out or path))


def _values(struct: Camera | Mount, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: msgspec.to_builtins(getattr(struct, name)) for name in names}


def _write(path: Path, robot: str, part: str, values: Mapping[str, Any], out: Path) -> None:
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    text = read_text(path, "give the path of a team.toml", limit=MAX_DESCRIPTION_SIZE, error=TeamError)
    team = parse_team(path, text)
    number = team.names.index(team[robot].name)
    try:
        document: Any = tomlkit.parse(text)
        table = document["robots"][number][part]
        for name, value in values.items():
            if getattr(getattr(team[robot], part), name) != (tuple(value) if isinstance(value, list) else value):
                table[name] = value
        text = tomlkit.dumps(document)
    except (TOMLKitError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise TeamError(f"{path}: cannot be edited ({error}); write the values of `{part}` by hand") from error
    _require_same(path, text, team, robot, part, values)
    write_atomically(out, text)


def _require_same(path: Path, text: str, team: Team, robot: str, part: str, values: Mapping[str, Any]) -> None:
    """Raise `TeamError` unless the new text differs from the team in the given values only."""
    wanted = msgspec.to_builtins(team)
    for one in wanted["robots"]:
        if one["name"] == robot:
            one[part] |= values
    if msgspec.to_builtins(parse_team(path, text)) != wanted:
        raise TeamError(f"{path}: cannot be edited automatically; write the values of `{part}` by hand")
