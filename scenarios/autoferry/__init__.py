"""Recorded plots of a ferry's radar and lidar in Trondheim, with the truth of two boats."""
