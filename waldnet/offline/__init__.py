"""A whole network in one process: replay, one tracker for all plots, and the in-memory network."""
