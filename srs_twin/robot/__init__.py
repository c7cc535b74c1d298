"""Robots: files with the unit, status and source of every number, and the frozen `RobotSpec`."""
