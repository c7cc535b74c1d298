"""Robot parameters, and robot files that store them with units and sources."""
