"""Output `rules`: events, snapshots, GPIO lines and commands after the values of devices passed a limit."""
