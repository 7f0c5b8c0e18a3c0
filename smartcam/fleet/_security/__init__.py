"""Security of a fleet: rights, certificates, their authority, and the agent's access check."""
