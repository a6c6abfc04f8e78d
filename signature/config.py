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
        0.1, ge=0, description="least distance of two boundary points; half a bin: coarser costs recognition"
    )

    freespace_bin_m: float = Field(0.4, gt=0, description="bin width of the free-space histogram (delta_f)")
    freespace_clearance_m: float = Field(
        0.2,
        ge=0,
        description="free space is eroded by this before thinning; less than half a door, so that obstacles "
        "in the way leave a way around them",
    )
    freespace_cell_m: float = Field(
        0.1, gt=0, description="cells in which the free-space skeleton is found; fine enough for the spacing"
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
    segment_step_deg: float = Field(
        2.0,
        gt=0,
        le=15,
        description="Hough's step in angle; a segment's direction comes from its ends, not from it",
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
        34.0,
        gt=0,
        description="crest of a straight line after the blur: what 0 and 255 give at 0.05 m, unscaled",
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

    window_m: float = Field(15.0, gt=0, description="how far back along its path a query remembers")
    step_m: float = Field(1.0, gt=0, description="a new look at the database every so many metres of travel")
    views: int = Field(8, gt=0, description="places of its path at which a query is described")
    view_spacing_m: float = Field(1.2, gt=0, description="least distance of two views")
    shortlist: int = Field(
        400, gt=0, description="places that the signatures hand to the comparison of isovists"
    )
    signature_weight: float = Field(
        0.2, ge=0, description="say of the signatures against the isovists' ranges; 0: none"
    )
    top_k: int = Field(50, gt=0, description="placements that retrieval hands to alignment")
    coarse_floor: float = Field(0.4, ge=0, le=1, description="coarse scores below this are not looked at")
    coarse_keep: float = Field(0.8, gt=0, le=1, description="nor those below this share of the best")
    hypotheses: int = Field(20, gt=0, description="hypotheses kept at most")
    exhaustive_m2: float = Field(
        20_000.0,
        ge=0,
        description="where signatures do not settle it, maps up to this free area are searched as a whole",
    )
    accept: float = Field(0.9, gt=0, lt=1, description="least confidence to answer located")


class Config(Section):
    """All sections; what `pc2grid config dump` prints.

    >>> config = Config()
    >>> config.partition.radius_m, config.relocalize.accept
    (5.0, 0.9)
    >>> Config(relocalize=RelocalizeConfig(accept=0.99)).relocalize.accept
    0.99
    """

    read: ReadConfig = ReadConfig()
    registration: RegistrationConfig = RegistrationConfig()
    projection: ProjectionConfig = ProjectionConfig()
    # A robot that has driven a few metres knows part of a disc of III-A, so by default submaps hold what is
    # seen from their centre, nearby, and lie close enough for every place to have one.
    partition: PartitionConfig = PartitionConfig(view="isovist", radius_m=5.0, spacing_m=1.0)
    signature: SignatureConfig = SignatureConfig()
    relocalize: RelocalizeConfig = RelocalizeConfig()
