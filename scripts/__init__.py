"""Programs that write parts of this repository: ``python -m scripts.NAME`` runs one."""
