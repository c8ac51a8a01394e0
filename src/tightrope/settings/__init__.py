"""How settings are declared, read, changed and written.

Internal: use the settings classes of the stories.
"""

__all__: list[str] = []
