"""Live twin of a robot."""
