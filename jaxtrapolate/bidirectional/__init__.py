"""Bidirectional reprojection (Yang et al. 2011): search and its starts, assistance by the target's buffers, runs."""
