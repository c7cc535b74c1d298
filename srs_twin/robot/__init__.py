"""Robot files, in which every number has a source, and the frozen `RobotSpec`."""
