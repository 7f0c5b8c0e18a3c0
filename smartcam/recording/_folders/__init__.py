"""Record beside an agent into a folder of files, and play that folder as a fleet."""
