"""Recorded ships in the Solent: truth for simulated radars."""
