"""Images and videos of the twin rendered by MuJoCo, and a window for keyboard control."""
