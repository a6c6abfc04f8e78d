"""The whole configuration tree, and the sections of the signature half."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from typing_extensions import Self

import pc2grid.settings
from pc2grid.settings import PartitionConfig, Section, Thinning

ShortlistBy = Literal[
    "signatures",
    "boundary",
    "freespace",
    "symmetry",
    "boundary+freespace",
    "boundary+symmetry",
    "freespace+symmetry",
    "shuffled",
    "random",
]
"""By the three signatures; as controls, by some of them, by those of another place, or by chance."""


class SignatureConfig(Section):
    """Submap -> three signatures and their distance (paper III-B to III-E).

    Names in brackets are the paper's; their defaults are Table II's. The rest the paper leaves open.
    """

    thinning: Literal["guo_hall", "zhang_suen", "as_cited"] = Field(
        "guo_hall",
        description="of boundary and free space; guo_hall treats all directions of a line alike; as_cited: "
        "guo_hall of the boundary, zhang_suen of the free space",
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
        "in the way leave a way around them; III-C names no erosion",
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
    segment_gap_m: float = Field(
        0.1, ge=0, description="largest gap between collinear pixels that Hough joins"
    )
    segment_votes: int = Field(
        6, gt=0, description="least number of Hough votes of a line; 0.3 m has 6 pixels of 0.05 m"
    )
    segment_step_deg: float = Field(
        2.0,
        gt=0,
        le=15,
        description="Hough's step in angle; the direction of a segment follows from its ends instead",
    )
    axis_vote: Literal["length", "plain"] = Field(
        "length",
        description="segments vote on the axes with their length, blurred and refined; or with one vote each",
    )
    axis_smoothing_deg: float = Field(
        2.0,
        gt=0,
        description="blur of the vote on angles, standard deviation; a pixel in 1 m is 3 degrees",
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
        description="value of a straight line after the blur; 34: an image of 0 and 255 at 0.05 m",
    )
    symmetry_limited: bool = Field(
        True, description="values above the peak, where lines meet, are cut to it; not so in the paper"
    )

    weight_boundary: float = Field(
        0.9, ge=0, le=1, description="weight of the boundary histogram (omega_b); omega_f is the rest"
    )
    symmetry_scale: float = Field(
        0.08, gt=0, description="scaling factor of Eq. 8 (eta); does not change the order of candidates"
    )
    symmetry_sigma: float = Field(120.0, gt=0, description="larger: symmetry counts less in Eq. 8 (sigma)")
    histogram_distance: Literal["hellinger", "bhattacharyya"] = Field(
        "hellinger",
        description="sqrt(1 - BC), which OpenCV calls Bhattacharyya's, 1 where histograms share no bin; or "
        "-ln BC, capped at 20",
    )

    @property
    def boundary_thinning(self) -> Thinning:
        """Return the thinning of the boundary (III-B 2, which cites another work than III-A)."""
        return "guo_hall" if self.thinning == "as_cited" else self.thinning

    @property
    def freespace_thinning(self) -> Thinning:
        """Return the thinning of the free space (III-C 1, which refers to III-A)."""
        return "zhang_suen" if self.thinning == "as_cited" else self.thinning

    @classmethod
    def paper(cls) -> Self:
        """Return the paper to the letter: two thinnings, free space not eroded (III-C) and at full
        resolution, no limit in S^G, one vote for each segment.

        The paper leaves open: which d of Eq. 6 it calls Bhattacharyya's (here OpenCV's, sqrt(1 - BC); the
        other reading is `histogram_distance="bhattacharyya"`); which of the two thinnings is which (Guo and
        Hall's in III-A would give killian 187 submaps, where Table I has 91); how far apart points and nodes
        are; the parameters of Hough's transform, how far apart the axes lie, and the blur. What is not named
        here is as in the default.

        >>> SignatureConfig.paper().histogram_distance, SignatureConfig.paper().freespace_thinning
        ('hellinger', 'zhang_suen')
        """
        return cls(
            thinning="as_cited",
            freespace_cell_m=0.05,
            freespace_clearance_m=0.0,
            symmetry_limited=False,
            axis_vote="plain",
        )


class LoopsConfig(Section):
    """Which loops are closed when a recording becomes a session."""

    recognize: bool = Field(
        True,
        description="recognise earlier places by signatures and shape, however far tracking has drifted; "
        "false: search near the tracked pose only",
    )


class RelocalizeConfig(Section):
    """Query -> hypotheses -> answer."""

    window_m: float = Field(
        8.0, gt=0, description="length of the latest part of its path that a query is made of"
    )
    step_m: float = Field(1.0, gt=0, description="metres of travel between two searches of the database")
    views: int = Field(8, gt=0, description="number of views that describe a query, half of them on its path")
    view_spacing_m: float = Field(1.2, gt=0, description="least distance of two views")
    shortlist_by: ShortlistBy = Field(
        "signatures",
        description="what orders the places where a query is looked for; the others are controls, which show"
        " what the signatures are worth: some of the three; shuffled, by those of another viewpoint; random",
    )
    coarse_floor: float = Field(
        0.4, ge=0, le=1, description="placements with a lower coarse score are dropped"
    )
    coarse_keep: float = Field(
        0.9, gt=0, le=1, description="and so are those below this share of the best one; 0.8 takes longer"
    )
    hypotheses: int = Field(20, gt=0, description="largest number of hypotheses that are kept")
    accept: float = Field(0.75, gt=0, lt=1, description="least confidence to answer located")


class Config(pc2grid.settings.Config):
    """All sections; what `pc2grid config dump` prints.

    >>> config = Config()
    >>> config.partition.radius_m, config.relocalize.accept
    (5.0, 0.75)
    >>> Config(relocalize=RelocalizeConfig(accept=0.99)).relocalize.accept
    0.99
    """

    signature: SignatureConfig = SignatureConfig()
    loops: LoopsConfig = LoopsConfig()
    relocalize: RelocalizeConfig = RelocalizeConfig()

    @classmethod
    def paper(cls) -> Self:
        """Return the defaults, but with the submaps and signatures of the paper."""
        return cls(partition=PartitionConfig.paper(), signature=SignatureConfig.paper())
