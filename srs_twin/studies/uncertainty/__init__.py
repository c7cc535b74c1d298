"""Uncertainty of predicted metrics due to the uncertain parameters of a robot."""
