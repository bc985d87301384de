"""What sensor nodes and the fusion center share."""
