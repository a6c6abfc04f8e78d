"""The whole configuration tree, and the sections of the signature half."""

from __future__ import annotations

from pydantic import Field

from pc2grid.config import PartitionConfig, ProjectionConfig, ReadConfig, RegistrationConfig, Section


class SignatureConfig(Section):
    """Submap -> three signatures and their distance (paper III-B to III-E; defaults of Table II)."""

    boundary_bin_m: float = Field(0.2, gt=0, description="bin width of the boundary histogram, delta_b")
    freespace_bin_m: float = Field(0.4, gt=0, description="bin width of the free-space histogram, delta_f")


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
