"""Guided fuzzing of every parser: `make fuzz`."""
