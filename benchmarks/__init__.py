"""Measurements, and the networks of bad links they and the tests run on."""
