"""Write a calibration into a team.toml: all else in it stays as it is, comments too."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from coloc_graph.errors import TeamError
from coloc_graph.input_file import MAX_DESCRIPTION_SIZE, read_text
from coloc_graph.run.atomic_file import write_atomically
from coloc_graph.team import Camera, Mount, Team, parse_team

#: What a calibration says of a camera, and of a mount; the rest is the robot's own.
CAMERA_FIELDS = ("width", "height", "fx", "fy", "cx", "cy", "distortion", "noise_px", "bias_px")
MOUNT_FIELDS = ("height", "tilt_deg", "roll_deg", "height_sigma", "tilt_sigma_deg", "roll_sigma_deg")


def write_camera(path: str | Path, robot: str, camera: Camera, out: str | Path | None = None) -> None:
    """Give a robot of the team at `path` this camera, in the file or in a new one at `out`; see `CAMERA_FIELDS`."""
    _write(Path(path), robot, "camera", _values(camera, CAMERA_FIELDS), Path(out or path))


def write_mount(path: str | Path, robot: str, mount: Mount, out: str | Path | None = None) -> None:
    """Give a robot of the team at `path` this mount, in the file or in a new one at `out`; see `MOUNT_FIELDS`."""
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
        raise TeamError(f"{path}: cannot be changed ({error}); write the values of `{part}` by hand") from error
    _require_same(path, text, team, robot, part, values)
    write_atomically(out, text)


def _require_same(path: Path, text: str, team: Team, robot: str, part: str, values: Mapping[str, Any]) -> None:
    """The new text says what was asked for, and of all else the same."""
    wanted = msgspec.to_builtins(team)
    for one in wanted["robots"]:
        if one["name"] == robot:
            one[part] |= values
    if msgspec.to_builtins(parse_team(path, text)) != wanted:
        raise TeamError(f"{path}: cannot be changed as it is written; write the values of `{part}` by hand")
