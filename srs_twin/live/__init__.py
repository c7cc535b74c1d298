"""Live twin of a robot: messages, estimation, fault detection, steering, emulator."""
