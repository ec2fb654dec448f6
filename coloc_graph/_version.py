"""The version, in one place; light to import, so that the build reads it without the dependencies."""

__version__ = "1.0.0rc1"
