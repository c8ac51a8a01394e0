"""The command line. Internal: use the commands."""

__all__: list[str] = []
