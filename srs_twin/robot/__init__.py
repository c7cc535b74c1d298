"""Parameters of robots, and robot files in which every number has a source."""
