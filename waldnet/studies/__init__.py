"""The network in one process: replay, the in-memory network, figures."""
