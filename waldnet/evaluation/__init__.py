"""How well runs found their targets, and how often false tracks come."""
