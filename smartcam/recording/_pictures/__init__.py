"""Pictures in recordings: their messages, their recorder, and their replay as a source."""
