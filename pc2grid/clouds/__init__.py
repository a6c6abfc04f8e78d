"""Operations on one cloud: deskewing, ground plane, normals, and reduction to a planar scan."""
