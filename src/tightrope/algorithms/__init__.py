"""Update rules: one file each, one signature; settings.py is importable without torch."""
