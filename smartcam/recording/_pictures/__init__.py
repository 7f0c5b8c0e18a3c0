"""Pictures in recordings: their messages, their recorders, and a driver that replays them."""
