"""Finished runs as Rerun recordings, and the viewer that shows them."""
