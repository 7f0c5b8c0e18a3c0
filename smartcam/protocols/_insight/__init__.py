"""In-Sight's native mode: commands and answers are lines of text."""
