"""What runs leave behind: the run folder, JSON lines, inputs, figures."""
