"""Images and videos of the twin, and keyboard control in MuJoCo's viewer."""
