"""RobotSpec and World as MJCF: the model and its export."""
