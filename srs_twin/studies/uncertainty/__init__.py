"""Every number with an interval: what is uncertain of a robot, propagated to what a scenario predicts."""
