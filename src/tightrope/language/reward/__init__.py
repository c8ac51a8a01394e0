"""Who judges responses."""
