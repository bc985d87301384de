"""Monte Carlo studies: modes of fusion side by side on the same simulated worlds."""
