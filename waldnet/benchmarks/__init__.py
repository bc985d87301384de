"""What the network costs: ``waldnet bench``, and the figures of docs/performance.md."""
