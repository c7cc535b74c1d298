"""Uncertainty of predicted metrics due to uncertain robot parameters."""
