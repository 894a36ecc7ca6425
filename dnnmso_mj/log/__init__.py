"""The log of a run, byte by byte: what its writer and its readers share."""
