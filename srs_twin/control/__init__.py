"""Controllers: functions of sensor readings and poses that return valve commands."""
