"""Every number that a user may turn, with its unit, default and reason, for the point-cloud half.

A section per stage; each stage takes only its own. Sections are frozen; unknown keys and values out of
range are `ConfigError`s that name the key and the closest known one. The whole tree with the sections
of `signature` is `signature.config.Config`.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Section(BaseModel):
    """Base of all sections: frozen, no unknown keys, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, data: Any) -> Any:
        """A section given in part keeps the other defaults of this tree, which may not be its class's."""
        if not isinstance(data, dict):
            return data
        parts = {name: field.default for name, field in cls.model_fields.items()}
        return {
            key: parts[key].model_dump() | value
            if isinstance(value, dict) and isinstance(parts.get(key), Section)
            else value
            for key, value in data.items()
        }


class ReadConfig(Section):
    """How a recording is read."""

    topic: str | None = Field(None, description="topic of the scans; null: the only one that fits")
    odometry: str | None = Field(None, description='odometry topic; null: found in the log; "none": ignored')
    base_frame: str | None = Field(
        None, description="null: base_link, base_footprint, or the sensor if no tf"
    )
    assume_identity: bool = Field(
        False, description="treat a sensor frame that tf does not connect as the base"
    )
    depth_stride: int = Field(
        2, ge=1, le=16, description="every n-th row and column of a depth image is used"
    )
    point_time: Literal["auto", "s", "ms", "us", "ns", "none"] = Field(
        "auto", description="unit of the per-point times of a cloud; none: ignore them"
    )
    max_range_m: float = Field(1000.0, gt=0, description="farther returns are not believed by any sensor")
    max_chunk_bytes: int = Field(256 << 20, gt=0, description="a chunk that expands to more is refused")
    max_record_bytes: int = Field(1 << 30, gt=0, description="a larger record of a log is refused")
    max_points: int = Field(20_000_000, gt=0, description="a scan that claims more points is refused")


class RegistrationConfig(Section):
    """Scans -> poses."""

    voxel_m: float | None = Field(
        default=None, gt=0, description="KISS-ICP voxel; null: chosen from the data"
    )
    min_range_m: float = Field(default=0.3, ge=0, description="nearer returns are the robot itself")
    max_range_m: float | None = Field(default=None, gt=0, description="null: chosen from the data")
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
    max_cells: int = Field(default=100_000_000, gt=0, description="a map larger than this is refused")


class PartitionConfig(Section):
    """Occupancy grid -> submaps (paper III-A)."""

    view: Literal["disc", "isovist"] = Field(
        "disc",
        description="disc: all within the radius, as III-A; isovist: only what is seen from the centre",
    )
    radius_m: float = Field(8.0, gt=0, description="submap radius r (Table II)")
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
        None,
        gt=0,
        description="also a submap every so far along the skeleton; null: junctions only, as III-A",
    )
