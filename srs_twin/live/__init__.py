"""Live: a robot on the air. What it says and is told, over MQTT and NatNet; a stand-in for it; recordings."""
