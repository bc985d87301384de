"""The process of one sensor: sources of scans, the local tracker, the shell around it."""
