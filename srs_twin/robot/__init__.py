"""Robot parameters, and robot files in which every number has a source."""
