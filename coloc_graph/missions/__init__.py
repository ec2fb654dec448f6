"""Whole missions on simulated time: shipped programs of robots and coordinator, of which one seed decides everything.

`Scheduler` runs their threads one at a time, `Network`, `Field` and `Host` take the place of zenoh, serial lines,
cameras and computers, `run_mission` checks what is promised (docs/missions.md).
"""
