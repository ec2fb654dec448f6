"""Correspondences between two cameras: time, identity, clock offset, and checks on them."""
