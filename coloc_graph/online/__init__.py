"""A team in the field: a robot's own program, the coordinator, and what passes between decisions and devices.

`RobotProgram` runs on each robot, `Coordinator` once; docs/online.md says what happens when.
"""
