"""Live twin of a robot: messages over MQTT and NatNet, estimation, fault detection, steering, an emulator."""
