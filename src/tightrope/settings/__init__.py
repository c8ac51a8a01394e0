"""How settings are declared, read, changed and written."""
