"""Operations on clouds: deskewing, downsampling, ground plane, planar scan, and columns of fused clouds."""
