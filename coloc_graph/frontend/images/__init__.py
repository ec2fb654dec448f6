"""Markers in images: blobs, sub-pixel centroids with covariances, AprilTags."""
