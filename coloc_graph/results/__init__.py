"""Results on disk: writing, reading, comparing, and solving many runs."""
