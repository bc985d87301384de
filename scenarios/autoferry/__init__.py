"""Recorded plots of a ferry's radar, lidar and cameras in Trondheim, with the truth of two boats."""
