"""Messages that a browser may send: each is checked in full before viser sees it.

viser hands a message on as soon as its type is known: text where a number belongs stays in a control and breaks it for
every later client. Only what the viewer's own page sends is let through.
"""

import math
from typing import Annotated, Literal

import msgspec
import viser

COORDINATE_LIMIT = 1e9  # m; no camera of an honest browser is farther away
IMAGE_LIMIT = 1 << 16  # px
NAME_LIMIT = 1024  # characters of a text

Coordinate = Annotated[float, msgspec.Meta(ge=-COORDINATE_LIMIT, le=COORDINATE_LIMIT)]
Pixels = Annotated[int, msgspec.Meta(ge=0, le=IMAGE_LIMIT)]
Text = Annotated[str, msgspec.Meta(max_length=NAME_LIMIT)]
Vector = tuple[Coordinate, Coordinate, Coordinate]


class _ClientMessage(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """Base of the messages, distinguished by viser's names."""


class CameraMessage(_ClientMessage, tag="ViewerCameraMessage"):
    """Pose and lens of the browser's camera, in viser's world frame."""

    wxyz: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    position: Vector
    fov: Coordinate
    near: Coordinate
    far: Coordinate
    image_height: Pixels
    image_width: Pixels
    look_at: Vector
    up_direction: Vector


class ClickMessage(_ClientMessage, tag="ScenePointerMessage"):
    """Click into the scene, as a ray from the camera."""

    event_type: Literal["click"]
    ray_origin: Vector
    ray_direction: Vector
    screen_pos: tuple[tuple[Coordinate, Coordinate]]
    modifier: Text | None


class ControlValue(msgspec.Struct, forbid_unknown_fields=True):
    """New value of a control; no other property is a browser's to set."""

    value: bool | int | float | Text


class ControlMessage(_ClientMessage, tag="GuiUpdateMessage"):
    """Control that was moved."""

    uuid: Text
    updates: ControlValue


class CommandMessage(_ClientMessage, tag="CommandTriggerMessage"):
    """Command that was chosen, or its key pressed."""

    uuid: Text


class DragMessage(_ClientMessage, tag="TransformControlsUpdateMessage"):
    """New pose of something that is dragged by its arrows."""

    name: Text
    wxyz: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    position: Vector
    owner: Text = ""


class DragStartMessage(_ClientMessage, tag="TransformControlsDragStartMessage"):
    """Beginning of a drag."""

    name: Text
    owner: Text = ""


class DragEndMessage(_ClientMessage, tag="TransformControlsDragEndMessage"):
    """End of a drag."""

    name: Text
    owner: Text = ""


_decoder = msgspec.msgpack.Decoder(
    CameraMessage | ClickMessage | ControlMessage | CommandMessage | DragMessage | DragStartMessage | DragEndMessage
)


def is_permitted(message: str | bytes, gui: viser.GuiApi | None) -> bool:
    """Return whether a message has the form of an honest browser's, and its value fits the control it is for.

    Parameters
    ----------
    message
        As received: msgpack.
    gui
        The controls; None before there are any.
    """
    try:
        decoded = _decoder.decode(message)  # type: ignore[arg-type]  # text is refused like any other wrong form
    except (msgspec.MsgspecError, TypeError, UnicodeDecodeError, RecursionError):
        return False
    match decoded:
        case ClickMessage(ray_direction=direction):
            return math.hypot(*direction) > 0
        case DragMessage(wxyz=wxyz):
            return math.hypot(*wxyz) > 0
        case ControlMessage(uuid=uuid, updates=updates):
            control = gui and gui._gui_input_handle_from_uuid.get(uuid)  # viser has no public way to look it up
            return control is not None and _fits(control, updates.value)
    return True


def _fits(control: object, value: float | str) -> bool:
    """True if a control can have a value."""
    match control:
        case viser.GuiCheckboxHandle():
            return isinstance(value, bool)
        case viser.GuiSliderHandle():
            if isinstance(value, (bool, str)):
                return False
            rounding = 1e-6 * (control.max - control.min)  # the browser counts in steps, in floating point
            return control.min - rounding <= value <= control.max + rounding
        case viser.GuiDropdownHandle():
            return value in control.options
    return False
