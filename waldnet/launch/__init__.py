"""The command line ``waldnet``, and the launcher of a network on one machine."""
