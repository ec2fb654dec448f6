"""iRobot Create: driver, odometry, watchdog process, and an emulator."""
