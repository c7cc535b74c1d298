"""Robots: files with sourced numbers, and the frozen `RobotSpec` built from them."""
