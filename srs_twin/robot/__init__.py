"""One robot: every number with its unit, status and source, as a file and as a frozen RobotSpec."""
