"""Scenario files, recorded plots, and the simulation of truth and plots."""
