"""RobotSpec and World as MJCF: the model, its export, and the check of MJCF from anybody."""
