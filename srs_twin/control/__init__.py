"""Controllers that compute valve commands from bend readings and camera poses."""
