"""The whole configuration tree, and the sections of the signature half."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pc2grid.config import PartitionConfig, ProjectionConfig, ReadConfig, RegistrationConfig, Section


class SignatureConfig(Section):
    """Submap -> three signatures and their distance (paper III-B to III-E).

    Names in brackets are the paper's; their defaults are Table II's. The rest the paper leaves open.
    """

    occupied_percent: int = Field(
        65, ge=1, le=100, description="cells at or above are boundary (T^B); 65 is nav2's occupied_thresh"
    )
    thinning: Literal["guo_hall", "zhang_suen"] = Field(
        "guo_hall", description="of boundary and free space; guo_hall treats all directions of a line alike"
    )

    boundary_bin_m: float = Field(0.2, gt=0, description="bin width of the boundary histogram (delta_b)")
    boundary_spacing_m: float = Field(
        0.2,
        ge=0,
        description="least distance of two boundary points: one bin, finer adds nothing to a histogram",
    )

    freespace_bin_m: float = Field(0.4, gt=0, description="bin width of the free-space histogram (delta_f)")
    freespace_clearance_m: float = Field(
        0.3, ge=0, description="free space is eroded by this before thinning; as in the partition"
    )
    freespace_spacing_m: float = Field(
        0.6,
        gt=0,
        description="least distance of two free-space nodes; half the width of a door and a corridor",
    )
    freespace_join_m: float | None = Field(
        None, gt=0, description="longest straight connection of two nodes; null: any, as printed in III-C 2"
    )

    segment_min_m: float = Field(0.3, gt=0, description="least length of a line segment (lambda_theta)")
    segment_gap_m: float = Field(0.1, ge=0, description="Hough joins collinear pixels across this much")
    segment_votes: int = Field(
        6, gt=0, description="Hough votes a line needs; about 0.3 m of pixels at 0.05 m"
    )
    axis_smoothing_deg: float = Field(
        2.0, gt=0, description="blur of the vote on angles; a pixel's step in a 1 m segment is 3 degrees"
    )
    axis_separation_deg: float = Field(
        30.0,
        gt=0,
        lt=90,
        description="least angle between the axes alpha and beta, so that one wall is not both",
    )
    symmetry_blur_m: float = Field(
        0.15, gt=0, description="standard deviation of the blur; mapping error plus the error of the axis"
    )
    symmetry_peak: float = Field(
        255.0,
        gt=0,
        description="crest of a straight line after the blur; the scale on which sigma = 120 bites",
    )

    weight_boundary: float = Field(
        0.9, ge=0, le=1, description="weight of the boundary histogram (omega_b); omega_f is the rest"
    )
    symmetry_scale: float = Field(0.08, gt=0, description="scaling factor of Eq. 8 (eta); orders nothing")
    symmetry_sigma: float = Field(120.0, gt=0, description="larger: symmetry counts less in Eq. 8 (sigma)")
    histogram_distance: Literal["hellinger", "bhattacharyya"] = Field(
        "hellinger",
        description="sqrt(1 - BC), bounded by 1 where histograms share no bin; or -ln BC, capped at 20",
    )


class RelocalizeConfig(Section):
    """Query -> hypotheses -> answer."""

    top_k: int = Field(20, gt=0, description="candidates that retrieval hands to alignment")


class Config(Section):
    """All sections; what `pc2grid config dump` prints."""

    read: ReadConfig = ReadConfig()
    registration: RegistrationConfig = RegistrationConfig()
    projection: ProjectionConfig = ProjectionConfig()
    partition: PartitionConfig = PartitionConfig()
    signature: SignatureConfig = SignatureConfig()
    relocalize: RelocalizeConfig = RelocalizeConfig()
