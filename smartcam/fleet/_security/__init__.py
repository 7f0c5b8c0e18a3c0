"""Security of a fleet: the rights of roles, certificates, and a filter for connections."""
