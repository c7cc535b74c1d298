"""Conversion of RobotSpec and World into MJCF: the model and its export."""
