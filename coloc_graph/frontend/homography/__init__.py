"""Homographies: fit, refinement, decomposition (eq. 2), maximum-likelihood pose, marker spans."""
