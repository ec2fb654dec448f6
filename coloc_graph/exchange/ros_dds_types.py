"""Messages of ROS 2 as DDS types, with the names that ROS 2 gives them on the wire: `pkg::msg::dds_::Name_`, `field_`.

Sources: common_interfaces of ROS 2 (Humble and later: Marker has a texture and a mesh file), rosidl_generator_dds_idl.
Needs `cyclonedds`.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float32, float64, int32, uint8, uint32

if TYPE_CHECKING:
    # to the checker, which knows Cyclone's as no generics
    sequence = list
    Covariance = list[float]
else:
    from cyclonedds.idl.types import array, sequence

    Covariance = array[float64, 36]


@dataclass
@final
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Time since the epoch."""

    sec_: int32
    nanosec_: uint32


@dataclass
@final
class Duration(IdlStruct, typename="builtin_interfaces::msg::dds_::Duration_"):
    """Duration."""

    sec_: int32 = 0
    nanosec_: uint32 = 0


@dataclass
@final
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Time and frame."""

    stamp_: Time
    frame_id_: str


@dataclass
@final
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """Vector [m]."""

    x_: float64
    y_: float64
    z_: float64


@dataclass
@final
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """Position [m]."""

    x_: float64
    y_: float64
    z_: float64


@dataclass
@final
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """Rotation."""

    x_: float64
    y_: float64
    z_: float64
    w_: float64


@dataclass
@final
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    """Translation and rotation."""

    translation_: Vector3
    rotation_: Quaternion


@dataclass
@final
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    """Pose of a child frame in the header's frame."""

    header_: Header
    child_frame_id_: str
    transform_: Transform


@dataclass
@final
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    """Transforms of /tf and /tf_static."""

    transforms_: sequence[TransformStamped]


@dataclass
@final
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """Position and rotation."""

    position_: Point
    orientation_: Quaternion


@dataclass
@final
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    """Pose at a time."""

    header_: Header
    pose_: Pose


@dataclass
@final
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    """Pose and covariance (6, 6), row by row, of x, y, z, and of rotations about the frame's axes."""

    pose_: Pose
    covariance_: Covariance


@dataclass
@final
class PoseWithCovarianceStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"):
    """Pose with covariance at a time."""

    header_: Header
    pose_: PoseWithCovariance


@dataclass
@final
class Path(IdlStruct, typename="nav_msgs::msg::dds_::Path_"):
    """Poses along a path."""

    header_: Header
    poses_: sequence[PoseStamped]


@dataclass
@final
class ColorRGBA(IdlStruct, typename="std_msgs::msg::dds_::ColorRGBA_"):
    """Colour, each part from 0 to 1."""

    r_: float32 = 0.0
    g_: float32 = 0.0
    b_: float32 = 0.0
    a_: float32 = 1.0


@dataclass
@final
class CompressedImage(IdlStruct, typename="sensor_msgs::msg::dds_::CompressedImage_"):
    """Texture of a marker, which ours have not."""

    header_: Header
    format_: str = ""
    data_: sequence[uint8] = field(default_factory=list)


@dataclass
@final
class UVCoordinate(IdlStruct, typename="visualization_msgs::msg::dds_::UVCoordinate_"):
    """Coordinates in a texture."""

    u_: float32
    v_: float32


@dataclass
@final
class MeshFile(IdlStruct, typename="visualization_msgs::msg::dds_::MeshFile_"):
    """Mesh of a marker, which ours have not."""

    filename_: str = ""
    data_: sequence[uint8] = field(default_factory=list)


@dataclass
@final
class Marker(IdlStruct, typename="visualization_msgs::msg::dds_::Marker_"):
    """Shape in RViz."""

    header_: Header
    ns_: str
    id_: int32
    type_: int32
    action_: int32
    pose_: Pose
    scale_: Vector3
    color_: ColorRGBA
    lifetime_: Duration
    frame_locked_: bool
    points_: sequence[Point]
    colors_: sequence[ColorRGBA]
    texture_resource_: str
    texture_: CompressedImage
    uv_coordinates_: sequence[UVCoordinate]
    text_: str
    mesh_resource_: str
    mesh_file_: MeshFile
    mesh_use_embedded_materials_: bool


@dataclass
@final
class MarkerArray(IdlStruct, typename="visualization_msgs::msg::dds_::MarkerArray_"):
    """Shapes in RViz."""

    markers_: sequence[Marker]
