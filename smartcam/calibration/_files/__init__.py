"""Keep calibrations in files, which are written whole or not at all and checked by a hash."""
