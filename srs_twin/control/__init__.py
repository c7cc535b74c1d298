"""Controllers, which compute valve commands from sensor readings and poses."""
