"""Plants: the analytical model and the MuJoCo twin, behind one contract."""
