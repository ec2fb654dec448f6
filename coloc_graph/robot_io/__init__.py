"""Devices of a robot: cameras, wheels, clocks, messages, coordination (knows devices; no graph)."""
