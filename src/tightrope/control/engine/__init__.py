"""Who computes: torch or the compiled CPU engine."""
