"""The agent: the process that has the sessions with cameras, and carries out programs' calls."""
