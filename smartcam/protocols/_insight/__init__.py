"""Native mode of Cognex In-Sight cameras: commands and answers are lines of text."""
