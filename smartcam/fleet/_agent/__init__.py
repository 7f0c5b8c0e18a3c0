"""The agent: it holds the sessions with its cameras and serves the programs' calls."""
