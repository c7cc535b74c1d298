"""What a lab recorded, as trajectories: readers, markers to body, logs, one clock."""
