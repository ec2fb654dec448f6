"""Deadlines between a command to move and wheels that stand, in one place.

A robot drives while permissions to move come from the coordinator's main loop. Each is valid for
`PERMISSION_LEASE` from the moment it was sent. The wheels must stand at most `STAND_WITHIN` after the last
permission.
"""

PERMISSION_PERIOD = 0.05  # the coordinator renews the permission to move after this time [s]
PERMISSION_LEASE = 0.18  # a robot stops after this time without a newer permission [s]
STAND_WITHIN = 0.5  # wheels stand at most this long after a process hangs, stops or ends, or a link is cut [s]
