"""``waldnet evaluate``: how well recorded runs found the targets that truly were there."""
