"""The settings of the point-cloud half: a name, unit, default and meaning for each number a user may change.

There is one section for each stage, and a stage takes only its own section. Sections are frozen. An
unknown key or a value out of range is an error. `Config` holds the sections of this package;
`signature.config.Config` adds those of the package above.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from typing_extensions import Self


class Section(BaseModel):
    """Base of all sections: frozen, no unknown keys, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """What differs from the defaults, so that a notebook shows one line and not a hundred settings."""
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if value != field.default:
                yield name, value


class ReadConfig(Section):
    """How a recording is read."""

    topic: str | None = Field(
        None, description="topic of the scans, or several, /a,/b, of one kind; null: the only one that fits"
    )
    odometry: str | None = Field(None, description='odometry topic; null: found in the log; "none": ignored')
    imu: str | None = Field(
        None, description='IMU topic; null: found where there is no odometry; "none": ignored'
    )
    base_frame: str | None = Field(
        None, description="null: base_link, base_footprint, or the sensor if no tf"
    )
    assume_identity: bool = Field(
        False, description="treat a sensor frame that tf does not connect as the base"
    )
    depth_stride: int = Field(
        2, ge=1, le=16, description="every n-th row and column of a depth image is used"
    )
    depth_unit_m: float | None = Field(
        None,
        gt=0,
        le=1,
        description="unit of depth images, m, such as 0.0002; null: 16UC1 in millimetres, 32FC1 in metres",
    )
    point_time: Literal["auto", "s", "ms", "us", "ns", "none"] = Field(
        "auto", description="unit of the per-point times of a cloud; none: ignore them"
    )
    max_range_m: float = Field(1000.0, gt=0, description="farther returns of any sensor are ignored")
    max_chunk_bytes: int = Field(256 << 20, gt=0, description="a chunk that expands to more is refused")
    max_record_bytes: int = Field(1 << 30, gt=0, description="a larger record of a log is refused")
    unit_m: float = Field(1.0, gt=0, le=1e4, description="unit of a cloud or mesh; 0.001: millimetres")
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = Field(
        "z", description="axis of a cloud or mesh that points up; -y: y points down, as in a camera"
    )
    floor_z: float | None = Field(
        None, description="height of a cloud's floor, m, after unit_m and up; null: found as a level plane"
    )
    max_points: int = Field(20_000_000, gt=0, description="a scan that claims more points is refused")


class RegistrationConfig(Section):
    """Scans -> poses."""

    icp: Literal["kiss-icp", "none"] = Field(
        default="kiss-icp",
        description="what brings a scan near; none: its predicted pose, as a control of what KISS-ICP does",
    )
    voxel_m: float | None = Field(
        default=None,
        gt=0,
        description="KISS-ICP voxel; null: a hundredth of its range, in the hand by the first ranges",
    )
    min_range_m: float = Field(default=0.3, ge=0, description="nearer returns are from the robot itself")
    max_range_m: float | None = Field(
        default=None, gt=0, description="of KISS-ICP; null: its own, 100 m; in the hand twice that of the map"
    )
    deskew: bool = Field(
        default=True, description="undo the motion within a scan where per-point times exist"
    )


class ProjectionConfig(Section):
    """Registered scans -> occupancy grid."""

    resolution_m: float = Field(default=0.05, gt=0.005, le=1.0, description="edge of a grid cell")
    band_min_m: float = Field(default=0.2, description="lower edge of the obstacle band above the floor")
    band_max_m: float = Field(default=1.8, description="upper edge of the obstacle band above the floor")
    max_range_m: float = Field(
        default=20.0, gt=0, description="returns farther than this do not draw the map"
    )
    points_voxel_m: float | None = Field(
        default=0.05,
        ge=0.01,
        le=1.0,
        description="of lidars and depth cameras the points in space are kept, too, one for each voxel of"
        " this edge; null: none",
    )
    max_cells: int = Field(default=100_000_000, gt=0, description="a map larger than this is refused")


class PartitionConfig(Section):
    """Occupancy grid -> submaps (paper III-A).

    By default a submap is what is seen within 5 m from a point every metre along the free space. A robot that
    has driven a few metres has seen all of such a view, but only a part of a disc. `paper` is the method of
    the paper: one disc of 8 m around each junction of the free space.

    >>> PartitionConfig.paper().view, PartitionConfig.paper().radius_m
    ('disc', 8.0)
    """

    view: Literal["disc", "isovist"] = Field(
        "isovist",
        description="isovist: only what is seen from the centre; disc: all within the radius, as III-A",
    )
    radius_m: float = Field(5.0, gt=0, description="submap radius r; the paper's is 8 (Table II)")
    clearance_m: float = Field(
        0.3,
        ge=0,
        description="free space is eroded by this before thinning: keeps doors, drops gaps in furniture",
    )
    cluster_m: float = Field(1.0, gt=0, description="DBSCAN radius that merges junction pixels")
    thinning: Literal["guo_hall", "zhang_suen"] = Field(
        "zhang_suen", description="zhang_suen keeps fewer side branches than guo_hall, so fewer junctions"
    )
    spacing_m: float | None = Field(
        1.0,
        gt=0,
        description="also a submap every so far along the skeleton; null: junctions only, as III-A",
    )

    @classmethod
    def paper(cls, radius_m: float = 8.0) -> Self:
        """Discs around junctions, as in the paper (III-A; 8 m is r of Table II)."""
        return cls(view="disc", radius_m=radius_m, spacing_m=None)


class Config(Section):
    """The settings of a recording's way to a map with submaps.

    >>> config = Config()
    >>> config.partition.radius_m, config.projection.resolution_m
    (5.0, 0.05)
    >>> Config.paper().partition.radius_m
    8.0
    """

    read: ReadConfig = ReadConfig()
    registration: RegistrationConfig = RegistrationConfig()
    projection: ProjectionConfig = ProjectionConfig()
    partition: PartitionConfig = PartitionConfig()

    @classmethod
    def paper(cls) -> Self:
        """The defaults, but with the submaps of the paper."""
        return cls(partition=PartitionConfig.paper())
