"""From markers to the shape of a body."""
