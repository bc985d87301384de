"""Recorded plots of a ship's radar off Trondheim, with the truth of one fast boat."""
