"""ifm: the process interface PCIC."""
