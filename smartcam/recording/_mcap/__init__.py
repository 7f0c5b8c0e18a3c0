"""The MCAP file of a recording: its topics, and their messages as JSON."""
