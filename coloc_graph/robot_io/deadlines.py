"""Deadlines between a command to move and standing wheels, in one place.

A robot drives while permissions to move come from the coordinator's main loop. Whatever a motion depends on (that
permission, sensor data, a driver that runs, a watchdog process that answers) may fail to show for `reaction_time` of
the wheels' speed before the wheels are stopped, so that they stand within `STAND_WITHIN`.
"""

PERMISSION_PERIOD = 0.05  # the coordinator renews the permission to move after this time [s]
PERMISSION_LEASE = 0.18  # a robot gives up its drive after this time without a newer permission [s]
STAND_WITHIN = 0.5  # wheels stand at most this long after a process hangs, stops or ends, or a link is cut [s]
DECELERATION = 2.0  # of a wheel after a stop command [m/s^2]; an assumption, not measured on a robot
STOP_MARGIN = 0.13  # for scheduling on a loaded computer, the serial line and the robot itself [s]


def reaction_time(speed: float) -> float:
    """Time from the last sign of life to the stop command [s].

    Parameters
    ----------
    speed
        Speed of the faster wheel [m/s].

    Returns
    -------
    float
        `STAND_WITHIN` less the time that the wheel takes to stand and less `STOP_MARGIN`: the faster, the shorter.
    """
    return STAND_WITHIN - STOP_MARGIN - abs(speed) / DECELERATION
