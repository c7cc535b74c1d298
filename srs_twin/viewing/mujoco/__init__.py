"""Images and videos of the twin, and a window for keyboard control, using MuJoCo."""
