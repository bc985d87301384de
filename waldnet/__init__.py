"""Sensors scattered over a network decide together, by Wald's sequential test, which tracks are real."""
