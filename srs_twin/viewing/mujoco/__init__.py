"""Images and videos of the twin, and a window with keyboard control, using MuJoCo."""
