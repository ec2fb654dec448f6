"""Teams that drive all the time: poses on the floor by odometry, ranges and bearings to each other and to landmarks.

`filter_forward` is an EKF, `optimise_drive` the most likely of all in batch, `IncrementalDrive` with ISAM2.
"""
